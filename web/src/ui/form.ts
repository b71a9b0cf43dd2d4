/** All parameters: the ones that most people turn first, the others behind a fold. */

import type { Parameter } from "../api/schema";
import type { Choices } from "../request";
import { el } from "./dom";
import { field, type Field } from "./field";

/** What stands on top. A parameter that is not named here is there as well, below. */
const FIRST = ["preset", "kernel", "resolution", "isovalue", "smoothness", "select", "chains"];

export class Form {
  private readonly fields = new Map<string, Field>();

  /** Fills `home`; `changed` is told after every change, and whether a slider is still being dragged. */
  constructor(private readonly home: HTMLElement, parameters: Parameter[], private readonly changed: (name: string, live: boolean) => void) {
    const first = parameters.filter((p) => FIRST.includes(p.name)).sort((a, b) => FIRST.indexOf(a.name) - FIRST.indexOf(b.name));
    const others = parameters.filter((p) => !FIRST.includes(p.name));
    for (const parameter of parameters) this.fields.set(parameter.name, field(parameter, (name, value, live) => this.set(name, value, live)));
    const elements = (list: Parameter[]) => list.map((p) => this.fields.get(p.name)?.element).filter((e) => e !== undefined);
    home.replaceChildren(...elements(first));
    if (others.length) home.append(el("details", { class: "more" }, el("summary", {}, `More parameters (${others.length})`), ...elements(others)));
  }

  /** What is set, in the order of the description. */
  get choices(): Choices {
    return new Map([...this.fields].filter(([, f]) => f.value !== undefined).map(([name, f]) => [name, f.value as string]));
  }

  get names(): ReadonlySet<string> {
    return new Set(this.fields.keys());
  }

  /** Sets a value, or takes it back. What cannot stand beside it is taken back. */
  set(name: string, value: string | undefined, live = false): void {
    const field = this.fields.get(name);
    if (!field) return;
    if (field.value === value && !live) return this.changed(name, live);
    field.value = value;
    if (value !== undefined) for (const other of field.parameter.insteadOf) this.put(other, undefined);
    this.changed(name, live);
  }

  /** Sets values without telling. */
  fill(choices: Choices): void {
    for (const [name] of this.fields) this.put(name, choices.get(name));
    if ([...choices.keys()].some((name) => this.names.has(name) && !FIRST.includes(name))) this.home.querySelector("details")?.setAttribute("open", "");
  }

  /** What the service took for what is not set, from a report. */
  tell(report: Record<string, unknown>): void {
    for (const [name, { effective, parameter }] of this.fields) {
      const value = report[name];
      const numeric = parameter.kind === "number" || parameter.kind === "integer";
      if (numeric && typeof value === "number") effective(value);
    }
  }

  /** What a text field stands for in this structure, such as its chains. */
  hint(name: string, words: string): void {
    this.fields.get(name)?.effective(words);
  }

  private put(name: string, value: string | undefined): void {
    const field = this.fields.get(name);
    if (field && field.value !== value) field.value = value;
  }
}
