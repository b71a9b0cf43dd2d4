/** Display of the surface apart from parameters: sticks of ligands, transparency, hidden parts, view. */

import type { Client } from "../client/src/client";
import type { Source } from "./api/structures";
import { Ligands } from "./ligands";
import type { Choices } from "./request";
import { transparencyOf } from "./scene/context";
import { textOfView, viewOfText } from "./scene/view";
import type { Viewer } from "./scene/viewer";
import { $ } from "./ui/dom";

export interface DisplayState {
  /** True if ligands are drawn as sticks. */
  sticks: boolean;
  /** Transparency of the surface, per cent. */
  transparency: number;
  /** Names of hidden parts. */
  hidden: readonly string[];
  /** View as text; empty for the initial one. */
  view: string;
}

/** Time without movement, ms, after which the address contains the view. Browsers limit its changes per second. */
const REST = 300;

/** Reads the display from the pairs of the page's address. */
export function readDisplay(pairs: URLSearchParams): DisplayState {
  const hidden = (pairs.get("hide") ?? "").split(",").filter(Boolean).map(unescaped);
  const view = textOfView(viewOfText(pairs.get("camera") ?? ""));
  return { sticks: pairs.get("sticks") === "true", transparency: transparencyOf(pairs.get("transparency")), hidden, view };
}

/** Returns the pairs of the page's address, in the form of `readDisplay`. */
export function displayPairs({ sticks, transparency, hidden, view }: DisplayState): [string, string][] {
  const pairs: [string, string][] = [];
  if (sticks) pairs.push(["sticks", "true"]);
  if (transparency) pairs.push(["transparency", String(transparency)]);
  // Names may contain commas.
  if (hidden.length) pairs.push(["hide", hidden.map(encodeURIComponent).join(",")]);
  if (view) pairs.push(["camera", view]);
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
  private readonly ligands: Ligands;
  /** Structure and parameters of the shown surface. */
  private shown: { source: Source; choices: Choices } | null = null;
  /** View of the address. It changes when the camera has come to rest. */
  private view = "";
  /** View of the next surface; null if it does not change. */
  private nextView: string | null = null;
  private rest = 0;

  constructor(
    client: Client,
    private readonly viewer: Viewer,
    private readonly actions: DisplayActions,
  ) {
    this.ligands = new Ligands(client, viewer, (note) => ($("sticks-note").textContent = note));
    viewer.controls.addEventListener("change", () => {
      clearTimeout(this.rest);
      this.rest = window.setTimeout(() => this.rested(), REST);
    });
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
    return { sticks: this.sticks.checked, transparency, hidden: this.viewer.hiddenParts, view: this.view };
  }

  /** Sets the display of the next surface, which `follow` names. */
  set state({ sticks, transparency, hidden, view }: DisplayState) {
    this.view = this.nextView = view;
    this.sticks.checked = sticks;
    this.transparency.value = String(transparency);
    this.viewer.hideParts(hidden);
    this.veil();
  }

  /** Applies the view, and draws the ligands if switched on, of the surface that the viewer shows. */
  follow(source: Source, choices: Choices): void {
    if (this.nextView !== null) this.viewer.view = viewOfText(this.nextView);
    this.nextView = null;
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
    if (!this.sticks.checked || !this.shown) return this.ligands.clear();
    const { source, choices } = this.shown;
    this.ligands.show(source.path, choices).catch((error: unknown) => this.actions.failed(error));
  }

  private rested(): void {
    const view = textOfView(this.viewer.view);
    if (view === this.view) return;
    this.view = view;
    this.actions.changed();
  }
}
