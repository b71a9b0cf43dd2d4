/** Form of all parameters: common ones first, others in a collapsed section, picture settings beside the download. */

import type { Parameter } from "../api/schema";
import { type Choices, COLORS } from "../rules";
import { $, el } from "./dom";
import { type Changed, field, type Field, type Offer } from "./field";

/** Parameters at the top. Others follow below. */
const FIRST = [
  "preset", "surface", "probe", "resolution", "isovalue", "smoothness", "select", "chains", "assembly",
];

export class Form {
  private readonly fields: ReadonlyMap<string, Field>;
  private readonly more: HTMLDetailsElement;

  /** Fills the page with controls. Calls `changed` when the user sets or resets a value. */
  constructor(parameters: readonly Parameter[], changed: Changed) {
    const first = parameters.filter((p) => FIRST.includes(p.name)).sort((a, b) => FIRST.indexOf(a.name) - FIRST.indexOf(b.name));
    const others = parameters.filter((p) => !FIRST.includes(p.name) && !p.format);
    const apart = parameters.filter((p) => p.format);
    this.fields = new Map(parameters.map((parameter) => [parameter.name, field(parameter, changed)]));
    const elements = (list: Parameter[]) => list.map((p) => this.fields.get(p.name)?.element).filter((e) => e !== undefined);
    this.more = el("details", { class: "more", hidden: others.length === 0 }, el("summary", {}, `More parameters (${others.length})`), ...elements(others));
    $("parameters").replaceChildren(...elements(first), this.more);
    const pictures = $("picture-fields");
    pictures.replaceChildren(...elements(apart));
    if (pictures.parentElement) pictures.parentElement.hidden = apart.length === 0;
  }

  /** Shows the values. */
  render(choices: Choices): void {
    for (const [name, field] of this.fields) {
      const value = choices.get(name);
      if (field.value === value) continue;
      field.value = value;
      if (value !== undefined && !COLORS.includes(name) && this.more.contains(field.element)) this.more.open = true;
    }
  }

  /** Shows the values from a report that the service used by default. */
  showValues(report: Record<string, unknown>): void {
    for (const [name, { effective, parameter }] of this.fields) {
      const value = report[name];
      const numeric = parameter.kind === "number" || parameter.kind === "integer";
      if (numeric && typeof value === "number") effective(value);
    }
  }

  /** Shows the meaning of an empty text field for this structure, such as its chains. */
  hint(name: string, words: string): void {
    this.fields.get(name)?.effective(words);
  }

  /** Sets the values that a text field offers for this structure. */
  offer(name: string, values: Offer[]): void {
    this.fields.get(name)?.offer?.(values);
  }
}
