/** Form of all parameters: common ones first, others in a collapsed section, picture settings beside the download. */

import type { Parameter, Schemes } from "../api/schema";
import { type Choices, query } from "../request";
import { el } from "./dom";
import { field, type Field, type Offer } from "./field";

/** Storage parameters, which do not apply to pictures. */
const STORAGE = ["compress", "normals", "units", "atom_ids"];

/** Formats that can repeat a mesh (parameter `instances`). Others contain the joined surface of the assembly. */
const REPEATING = ["glb", "gltf"];

/** Parameters whose values name parts of one structure. */
const PARTS = ["model", "chains", "altloc", "assembly"];

/** Parameters of colours. Colours of atoms change the shown surface without a new mesh. */
const COLORS = ["color", "palette", "color_range", "color_blend"];

const isOfColors = ({ name }: Parameter) => COLORS.includes(name);
/** Returns true if a parameter always changes the mesh. */
const isOfShape = (parameter: Parameter) => parameter.format === "" && !isOfColors(parameter);

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
  constructor(private readonly home: HTMLElement, pictures: HTMLElement, parameters: Parameter[], private readonly schemes: Schemes, private readonly changed: (mesh: boolean, live: boolean) => void) {
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

  /** Returns true if the colours belong to vertices, so that they come with the mesh. */
  coloursVertices(choices: Choices): boolean {
    const scheme = choices.get("color") ?? "none";
    if (scheme === "none") return false;
    const isOfAtoms = scheme.startsWith("uniform:") || this.schemes.ofAtoms.has(scheme);
    return !isOfAtoms || choices.get("color_blend") === "smooth";
  }

  /** Returns the values in `choices` that affect the displayed mesh. */
  mesh(choices: Choices): Choices {
    const withColors = this.coloursVertices(choices);
    return this.chosen(choices, (parameter) => isOfShape(parameter) || (withColors && isOfColors(parameter)));
  }

  /** Returns the parameters of a surface: the shape in `choices`, with the set colours and parameters of one format. */
  displayed(choices: Choices): Choices {
    const all = this.all;
    // New colours of vertices come with the next mesh.
    const colors = this.coloursVertices(all) ? choices : all;
    const apart = this.chosen(all, ({ format }) => format !== "");
    return new Map([...this.chosen(choices, isOfShape), ...this.chosen(colors, isOfColors), ...apart]);
  }

  /** Returns the values in `choices` that apply to a file of `format`. */
  of(format: string, choices: Choices): Choices {
    const isApart = [...this.fields.values()].some(({ parameter }) => parameter.format === format);
    const isExcluded = (name: string) => (isApart && STORAGE.includes(name)) || (name === "instances" && !REPEATING.includes(format));
    return this.chosen(choices, ({ name, format: only }) => (only === "" && !isExcluded(name)) || only === format);
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
    const { parameter } = field;
    const before = query(this.mesh(this.all));
    field.value = value;
    if (value !== undefined) for (const other of parameter.insteadOf) this.put(other, undefined);
    const now = this.all;
    const needsMesh = isOfColors(parameter) ? this.coloursVertices(now) && query(this.mesh(now)) !== before : isOfShape(parameter);
    this.changed(needsMesh, live);
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

  /** Sets the values that a text field offers for this structure. */
  offer(name: string, values: Offer[]): void {
    this.fields.get(name)?.offer?.(values);
  }

  /** Sets a value without calling `changed`. */
  put(name: string, value: string | undefined): void {
    const field = this.fields.get(name);
    if (field && field.value !== value) field.value = value;
  }
}
