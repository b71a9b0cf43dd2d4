/** Form of all parameters: common ones first, others in a collapsed section, picture settings beside the download. */

import type { Parameter } from "../api/schema";
import type { Choices } from "../request";
import { el } from "./dom";
import { field, type Field } from "./field";

/** Storage parameters, which do not apply to pictures. */
const STORAGE = ["compress", "normals", "units", "atom_ids"];

/** Parameters whose values name parts of one structure. */
const PARTS = ["model", "chains", "altloc", "assembly"];

/** Parameters of colours, which change the shown surface without a new mesh. */
const COLORS = ["color", "palette", "color_range"];

/** Returns true if a parameter changes the displayed mesh. */
const isOfMesh = ({ name, format }: Parameter) => format === "" && !COLORS.includes(name);

/** Parameters at the top. Others follow below. */
const FIRST = [
  "preset", "surface", "probe", "resolution", "isovalue", "smoothness", "select", "chains", "assembly",
];

export class Form {
  private readonly fields = new Map<string, Field>();

  /**
   * Fills `home`, and `pictures` with parameters of single formats. Calls `changed` after every change and
   * states whether it affects the mesh and whether a slider is still being dragged.
   */
  constructor(private readonly home: HTMLElement, pictures: HTMLElement, parameters: Parameter[], private readonly changed: (mesh: boolean, live: boolean) => void) {
    const first = parameters.filter((p) => FIRST.includes(p.name)).sort((a, b) => FIRST.indexOf(a.name) - FIRST.indexOf(b.name));
    const others = parameters.filter((p) => !FIRST.includes(p.name) && !p.format);
    const apart = parameters.filter((p) => p.format);
    for (const parameter of parameters) this.fields.set(parameter.name, field(parameter, (name, value, live) => this.set(name, value, live)));
    const elements = (list: Parameter[]) => list.map((p) => this.fields.get(p.name)?.element).filter((e) => e !== undefined);
    home.replaceChildren(...elements(first));
    pictures.replaceChildren(...elements(apart));
    if (pictures.parentElement) pictures.parentElement.hidden = apart.length === 0;
    if (others.length) home.append(el("details", { class: "more" }, el("summary", {}, `More parameters (${others.length})`), ...elements(others)));
  }

  /** Returns all set values, in the order of the document. */
  get all(): Choices {
    return new Map([...this.fields].flatMap(([name, { value }]) => (value === undefined ? [] : [[name, value]])));
  }

  /** Returns the values in `choices` that affect the mesh. */
  mesh(choices: Choices): Choices {
    return this.chosen(choices, isOfMesh);
  }

  /** Returns the values in `choices` that do not change the displayed mesh: colours and parameters of one format. */
  apart(choices: Choices): Choices {
    return this.chosen(choices, (parameter) => !isOfMesh(parameter));
  }

  /** Returns the values in `choices` that apply to a file of `format`. */
  of(format: string, choices: Choices): Choices {
    const isApart = [...this.fields.values()].some(({ parameter }) => parameter.format === format);
    return this.chosen(choices, ({ name, format: only }) => (only === "" && !(isApart && STORAGE.includes(name))) || only === format);
  }

  private chosen(choices: Choices, which: (parameter: Parameter) => boolean): Choices {
    return new Map([...choices].filter(([name]) => {
      const field = this.fields.get(name);
      return field !== undefined && which(field.parameter);
    }));
  }

  get names(): ReadonlySet<string> {
    return new Set(this.fields.keys());
  }

  /** Sets or resets a value, and resets parameters that it excludes. */
  set(name: string, value: string | undefined, live = false): void {
    const field = this.fields.get(name);
    if (!field) return;
    const mesh = isOfMesh(field.parameter);
    if (field.value === value && !live) return this.changed(mesh, live);
    field.value = value;
    if (value !== undefined) for (const other of field.parameter.insteadOf) this.put(other, undefined);
    this.changed(mesh, live);
  }

  /** Sets all values without calling `changed`. */
  fill(choices: Choices): void {
    for (const [name] of this.fields) this.put(name, choices.get(name));
    if ([...choices.keys()].some((name) => this.fields.get(name)?.parameter.format === "" && ![...FIRST, ...COLORS].includes(name))) this.home.querySelector("details")?.setAttribute("open", "");
  }

  /** Resets parameters that name parts of the previous structure without calling `changed`. */
  forget(): void {
    for (const name of PARTS) this.put(name, undefined);
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

  /** Sets the values that a text field suggests for this structure. */
  offer(name: string, values: string[]): void {
    this.fields.get(name)?.offer?.(values);
  }

  /** Sets a value without calling `changed`. */
  put(name: string, value: string | undefined): void {
    const field = this.fields.get(name);
    if (field && field.value !== value) field.value = value;
  }
}
