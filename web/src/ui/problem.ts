/** Error message of the service with buttons for remedies. */

import type { ProblemDocument } from "../../client/src/problem";
import type { Failure } from "../view";
import { el } from "./dom";

export interface Remedies {
  /** Requests what failed with another value of a parameter, or its default (undefined). */
  set(parameter: string, value: string | undefined): void;
  close(): void;
  /** Opens the sample; absent if a surface is shown. */
  sample: (() => void) | undefined;
}

/** Shows a failure in `home`, and in `kept` what the page still shows. */
export function showProblem(home: HTMLElement, { problem: { document }, view, again }: Failure, kept: string, remedies: Remedies): void {
  const act = (words: string, action: () => void, primary = false) => {
    const button = el("button", { type: "button", class: primary ? "primary" : "" }, words);
    button.addEventListener("click", () => {
      remedies.close();
      action();
    });
    return button;
  };
  const actions: HTMLElement[] = [];
  const { suggested_resolution: suggested, parameter: named } = document;
  if (view && typeof suggested === "number") actions.push(act(`Use ${suggested} Å`, () => remedies.set("resolution", String(suggested)), true));
  // The colours of atoms call the parameter `color` their scheme.
  const parameter = named === "scheme" ? "color" : named;
  if (view && typeof parameter === "string") actions.push(act(`Reset ${parameter.replaceAll("_", " ")}`, () => remedies.set(parameter, undefined)));
  if (again && (document.status === 0 || document.status >= 500 || document.status === 429)) actions.push(act("Try again", again));
  if (remedies.sample) actions.push(act("Show the sample", remedies.sample));
  actions.push(act("Close", () => undefined));
  const list = numbersOf(document).filter(([name]) => name !== "suggested resolution").flatMap(([name, value]) => [el("dt", {}, name), el("dd", {}, value)]);
  home.replaceChildren(
    el("strong", {}, view ? `${view.source.name}: ${document.title}` : document.title),
    ...(document.detail ? [el("p", {}, document.detail)] : []),
    ...(kept ? [el("p", { class: "kept" }, kept)] : []),
    ...(list.length ? [el("dl", {}, ...list)] : []),
    el("div", { class: "row" }, ...actions),
  );
}

/** Returns the names and values of non-standard members, formatted for display. */
function numbersOf(document: ProblemDocument): [string, string][] {
  const standard = ["type", "title", "status", "detail", "instance", "diagnostics"];
  return Object.entries(document)
    .filter(([name, value]) => !standard.includes(name) && value !== null && typeof value !== "object")
    .map(([name, value]) => [name.replaceAll(/[_-]/g, " "), typeof value === "number" ? value.toLocaleString("en") : String(value)]);
}
