/** Error message of the service with buttons for remedies. */

import type { Problem, ProblemDocument } from "../../client/src/problem";
import { el } from "./dom";

export interface Remedies {
  /** Applies a grid spacing that should fit. */
  takeResolution(resolution: number): void;
  /** Resets a parameter to its default. */
  reset(parameter: string): void;
  /** Tries again. */
  again(): void;
}

/** Context of a problem. */
export interface About {
  /** The structure whose request failed; empty: none. */
  name: string;
  /** Sentence on what the page still shows; empty: none. */
  kept: string;
}

/** Shows a problem in `home`. */
export function problem(home: HTMLElement, { document }: Problem, about: About, remedies: Remedies): void {
  const act = (words: string, action: () => void, primary = false) => {
    const button = el("button", { type: "button", class: primary ? "primary" : "" }, words);
    button.addEventListener("click", () => {
      home.hidden = true;
      action();
    });
    return button;
  };
  const actions: HTMLElement[] = [];
  const suggested = document.suggested_resolution;
  if (typeof suggested === "number") actions.push(act(`Use ${suggested} Å`, () => remedies.takeResolution(suggested), true));
  const parameter = document.parameter;
  if (typeof parameter === "string") actions.push(act(`Reset ${parameter.replaceAll("_", " ")}`, () => remedies.reset(parameter)));
  if (document.status === 0 || document.status >= 500 || document.status === 429) actions.push(act("Try again", () => remedies.again()));
  actions.push(act("Close", () => undefined));
  const list = numbersOf(document).filter(([name]) => name !== "suggested resolution").flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value)]);
  home.replaceChildren(
    el("strong", {}, about.name ? `${about.name}: ${document.title}` : document.title),
    ...(document.detail ? [el("p", {}, document.detail)] : []),
    ...(about.kept ? [el("p", { class: "kept" }, about.kept)] : []),
    ...(list.length ? [el("dl", {}, ...list)] : []),
    el("div", { class: "row" }, ...actions),
  );
  home.hidden = false;
}

/** Returns the names and values of non-standard members, formatted for display. */
function numbersOf(document: ProblemDocument): [string, string][] {
  const standard = ["type", "title", "status", "detail", "instance", "diagnostics"];
  return Object.entries(document)
    .filter(([name, value]) => !standard.includes(name) && value !== null && typeof value !== "object")
    .map(([name, value]) => [name.replaceAll(/[_-]/g, " "), typeof value === "number" ? value.toLocaleString("en") : String(value)]);
}
