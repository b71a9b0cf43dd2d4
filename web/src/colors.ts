/** Colours of the shown surface: applies a colour scheme, and passes on its legend. */

import { atomColors, colorsPath, type Legend } from "./api/colors";
import type { Client } from "../client/src/client";
import type { Choices } from "./request";
import { palette } from "./scene/material";
import type { Viewer } from "./scene/viewer";

export class Colors {
  private abort: AbortController | null = null;
  /** Path of the colours that are shown or being fetched; empty for those of the file. */
  private path: string | null = null;
  private structure = "";

  /** `keepsFile`: without a scheme, the surface has the colours in its file, if there are any. */
  constructor(
    private readonly client: Client,
    private readonly viewer: Viewer,
    private readonly explain: (legend: Legend | null) => void,
    private readonly keepsFile: boolean,
  ) {}

  /** Colours the surface of a structure. Throws if the colours are not available; then the surface has one colour. */
  async apply(structure: string, choices: Choices, since = performance.now()): Promise<void> {
    const path = colorsPath(structure, choices);
    if (path === this.path) return;
    this.abort?.abort();
    // The colours of another structure do not fit these atoms.
    if (structure !== this.structure) this.clear();
    this.structure = structure;
    this.path = path;
    if (path === null) return this.clear();
    const { signal } = (this.abort = new AbortController());
    try {
      const { rgba, legend } = await atomColors(this.client, path, signal);
      signal.throwIfAborted();
      const received = performance.now();
      this.viewer.colour(palette(rgba), rgba.length / 4, this.keepsFile);
      this.explain(legend);
      const applied = performance.now();
      const drawn = await this.viewer.drawn();
      // Read by web/measure.mjs and the browser tests.
      const times = { received: received - since, applied: applied - received, drawn: drawn - applied };
      const detail = { atoms: rgba.length / 4, ...times };
      performance.measure("molmesh:recolor", { start: since, end: drawn, detail });
    } catch (error) {
      if (signal.aborted) return;
      this.clear();
      throw error;
    }
  }

  /** Shows the colours in the file of the surface, which `legend` describes. */
  useFile(structure: string, legend: Legend): void {
    this.abort?.abort();
    this.structure = structure;
    this.path = "";
    this.viewer.colour(null, 0, true);
    this.explain(legend);
  }

  /** Stops fetching colours. */
  stop(): void {
    this.abort?.abort();
  }

  private clear(): void {
    this.path = null;
    this.viewer.colour(null, 0, this.keepsFile);
    this.explain(null);
  }
}
