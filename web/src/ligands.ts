/** Ligands of the shown structure as sticks, for the page and the component. */

import { atomColors, colorsPath } from "./api/colors";
import type { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import { positions } from "./api/structures";
import { type Choices, query } from "./request";
import { MAX_ATOMS, sticks } from "./scene/sticks";
import type { Viewer } from "./scene/viewer";
import { number } from "./ui/dom";

/** Selection that is drawn as sticks. It includes cofactors and glycans. */
const SELECT = "ligand";
/** Parameters of the mesh that select atoms, besides `select`. */
const SHARED = ["model", "chains", "altloc", "assembly"];

export class Ligands {
  /** Path of the atoms that are drawn or being fetched. */
  private path = "";
  private abort: AbortController | null = null;

  /** `explain` is called with a note on the sticks, empty if there are none. */
  constructor(
    private readonly client: Client,
    private readonly viewer: Viewer,
    private readonly explain: (note: string) => void,
  ) {}

  /**
   * Draws the ligands of a structure, with the copies of the assembly in `choices`. Draws nothing if it has none.
   * Throws if they are not available.
   */
  async show(structure: string, choices: Choices): Promise<void> {
    const selection = new Map([["select", SELECT], ...[...choices].filter(([name]) => SHARED.includes(name))]);
    const path = structure + query(selection);
    if (path === this.path) return;
    this.clear("Reading the ligands…");
    this.path = path;
    const { signal } = (this.abort = new AbortController());
    try {
      await this.draw(structure, selection, signal);
    } catch (error) {
      if (signal.aborted) return;
      const isEmpty = error instanceof Problem && error.is("empty-selection");
      this.clear(isEmpty ? "No ligands in the selected chains." : "");
      if (!isEmpty) throw error;
      // An empty selection is the same for the next surface.
      this.path = path;
    }
  }

  /** Removes the sticks and gives a note. */
  clear(note = ""): void {
    this.abort?.abort();
    this.path = "";
    this.viewer.showSticks(null);
    this.explain(note);
  }

  /** Fetches the selected atoms and their colours, and draws them. */
  private async draw(structure: string, selection: Choices, signal: AbortSignal): Promise<void> {
    const colors = colorsPath(structure, new Map([...selection, ["color", "element"]])) ?? "";
    const [atoms, { rgba }] = await Promise.all([
      positions(this.client, structure, selection, signal),
      atomColors(this.client, colors, signal),
    ]);
    signal.throwIfAborted();
    const { x, y, z, index, elements, residues } = atoms;
    if (x.length > MAX_ATOMS) {
      return this.explain(`${number(x.length)} atoms of ligands; at most ${number(MAX_ATOMS)} can be drawn.`);
    }
    const own = new Uint8Array(4 * index.length);
    index.forEach((row, i) => own.set(rgba.subarray(4 * row, 4 * row + 4), 4 * i));
    const started = performance.now();
    const { geometry, bonds } = sticks({ x, y, z, elements, rgba: own });
    this.viewer.showSticks(geometry);
    // Read by the browser tests.
    performance.measure("molmesh:sticks", { start: started, detail: { sticks: x.length, bonds } });
    const names = [...new Set(residues)];
    const listed = names.slice(0, 8).join(", ");
    this.explain(`${number(x.length)} atoms: ${listed}${names.length > 8 ? ", …" : ""}`);
  }
}
