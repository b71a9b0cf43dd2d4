/** Colours of the shown surface: applies the colour scheme of the parameters, and shows its legend. */

import { atomColors, colorsPath } from "./api/colors";
import type { Client } from "./api/client";
import type { Choices } from "./request";
import { palette } from "./scene/material";
import type { Viewer } from "./scene/viewer";
import { showLegend } from "./ui/legend";

export class Colors {
  private abort: AbortController | null = null;
  /** Path of the colours that are shown or being fetched. */
  private path: string | null = null;
  private structure = "";

  constructor(private readonly client: Client, private readonly viewer: Viewer, private readonly legend: HTMLElement) {}

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
      this.viewer.colour(palette(rgba), rgba.length / 4);
      showLegend(this.legend, legend);
      const drawn = await this.viewer.drawn();
      // Read by web/measure.mjs and the browser tests.
      performance.measure("molmesh:recolor", { start: since, end: drawn, detail: { atoms: rgba.length / 4, received: received - since, drawn: drawn - received } });
    } catch (error) {
      if (signal.aborted) return;
      this.clear();
      throw error;
    }
  }

  private clear(): void {
    this.path = null;
    this.viewer.colour(null, 0);
    showLegend(this.legend, null);
  }
}
