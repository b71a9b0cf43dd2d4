/** Display of the surface apart from parameters: sticks of ligands, transparency, hidden parts. */

import { atomColors, colorsPath } from "./api/colors";
import type { Client } from "./api/client";
import { Problem } from "./api/problem";
import { type Source, positions } from "./api/structures";
import type { Choices } from "./request";
import { MAX_ATOMS, sticks } from "./scene/sticks";
import type { Viewer } from "./scene/viewer";
import { $, number } from "./ui/dom";

export interface DisplayState {
  /** True if ligands are drawn as sticks. */
  sticks: boolean;
  /** Transparency of the surface, per cent. */
  transparency: number;
  /** Names of hidden parts. */
  hidden: readonly string[];
}

/** Selection that is drawn as sticks. It includes cofactors and glycans. */
const SELECT = "ligand";
/** Parameters of the mesh that select atoms, besides `select`. */
const SHARED = ["model", "chains", "altloc", "assembly"];
const MAX_TRANSPARENCY = 90;

/** Reads the display from the pairs of the page's address. */
export function readDisplay(pairs: URLSearchParams): DisplayState {
  const value = Number(pairs.get("transparency"));
  const transparency = Number.isFinite(value) ? Math.min(MAX_TRANSPARENCY, Math.max(0, Math.round(value))) : 0;
  const hidden = (pairs.get("hide") ?? "").split(",").filter(Boolean).map(unescaped);
  return { sticks: pairs.get("sticks") === "true", transparency, hidden };
}

/** Returns the pairs of the page's address, in the form of `readDisplay`. */
export function displayPairs({ sticks, transparency, hidden }: DisplayState): [string, string][] {
  const pairs: [string, string][] = [];
  if (sticks) pairs.push(["sticks", "true"]);
  if (transparency) pairs.push(["transparency", String(transparency)]);
  // Names may contain commas.
  if (hidden.length) pairs.push(["hide", hidden.map(encodeURIComponent).join(",")]);
  return pairs;
}

function unescaped(name: string): string {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** Actions of the page. */
export interface DisplayActions {
  /** Called after the user has changed the display. */
  changed(): void;
  /** Divides the surface into chains, or joins it. */
  divide(byChain: boolean): void;
  failed(error: unknown): void;
}

export class Display {
  private readonly sticks = $<HTMLInputElement>("sticks");
  private readonly transparency = $<HTMLInputElement>("transparency");
  private readonly byChain = $<HTMLInputElement>("by-chain");
  private readonly note = $("sticks-note");
  /** Structure and parameters of the shown surface. */
  private shown: { source: Source; choices: Choices } | null = null;
  /** Path of the atoms that are drawn or being fetched. */
  private path = "";
  private abort: AbortController | null = null;

  constructor(
    private readonly client: Client,
    private readonly viewer: Viewer,
    private readonly actions: DisplayActions,
  ) {
    this.sticks.addEventListener("change", () => {
      this.update();
      actions.changed();
    });
    this.transparency.addEventListener("input", () => this.veil());
    // Browsers limit the changes of an address per second.
    this.transparency.addEventListener("change", () => actions.changed());
    this.byChain.addEventListener("change", () => actions.divide(this.byChain.checked));
  }

  get state(): DisplayState {
    const transparency = this.transparency.valueAsNumber;
    return { sticks: this.sticks.checked, transparency, hidden: this.viewer.hiddenParts };
  }

  /** Sets the display of the next surface, which `follow` names. */
  set state({ sticks, transparency, hidden }: DisplayState) {
    this.sticks.checked = sticks;
    this.transparency.value = String(transparency);
    this.viewer.hideParts(hidden);
    this.veil();
  }

  /** Shows the ligands of a structure, if they are switched on. */
  follow(source: Source, choices: Choices): void {
    this.shown = { source, choices };
    this.byChain.checked = choices.get("split") === "chain";
    this.update();
  }

  private veil(): void {
    const percent = this.transparency.valueAsNumber;
    this.transparency.setAttribute("aria-valuetext", `${percent} %`);
    $("transparency-value").textContent = `${percent} %`;
    this.viewer.setTransparency(percent / 100);
  }

  private update(): void {
    if (!this.sticks.checked || !this.shown) return this.clear("");
    const { source, choices } = this.shown;
    const shared = [...choices].filter(([name]) => SHARED.includes(name));
    const selection = new Map([["select", SELECT], ...shared]);
    const path = `${source.path} ${JSON.stringify([...selection])}`;
    if (path === this.path) return;
    this.clear("Reading the ligands…");
    this.path = path;
    const abort = (this.abort = new AbortController());
    this.draw(source, selection, abort.signal).catch((error: unknown) => {
      if (abort.signal.aborted) return;
      const isEmpty = error instanceof Problem && error.is("empty-selection");
      this.clear(isEmpty ? "No ligands in the selected chains." : "");
      // An empty selection is the same for the next surface.
      if (isEmpty) this.path = path;
      else this.actions.failed(error);
    });
  }

  /** Fetches the selected atoms and their colours, and draws them. */
  private async draw(source: Source, selection: Choices, signal: AbortSignal): Promise<void> {
    const colors = colorsPath(source.path, new Map([...selection, ["color", "element"]])) ?? "";
    const [atoms, { rgba }] = await Promise.all([
      positions(this.client, source, selection, signal),
      atomColors(this.client, colors, signal),
    ]);
    signal.throwIfAborted();
    const { x, y, z, index, elements, residues } = atoms;
    if (x.length > MAX_ATOMS) {
      this.note.textContent = `${number(x.length)} atoms of ligands; at most ${number(MAX_ATOMS)} can be drawn.`;
      return;
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
    this.note.textContent = `${number(x.length)} atoms: ${listed}${names.length > 8 ? ", …" : ""}`;
  }

  /** Removes the sticks and writes a note. */
  private clear(note: string): void {
    this.abort?.abort();
    this.path = "";
    this.viewer.showSticks(null);
    this.note.textContent = note;
  }
}
