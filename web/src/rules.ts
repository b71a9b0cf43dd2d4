/** Rules of the parameters: which ones exclude or need each other, and what depends on them. Without DOM. */

import type { Parameter, Schemes } from "./api/schema";

/** Parameters set by the user, by name; all others have their defaults. */
export type Choices = ReadonlyMap<string, string>;

/** Storage parameters, which do not apply to pictures. */
const STORAGE = ["compress", "normals", "units", "atom_ids"];

/** Formats that can repeat a mesh (parameter `instances`). Others contain the joined surface of the assembly. */
const REPEATING = ["glb", "gltf"];

/** Parameters that select atoms by the names of one structure, unlike `select`. */
export const SELECTION = ["model", "chains", "altloc", "assembly"];

/** Parameters of colours. Colours of atoms change the shown surface without a new mesh. */
export const COLORS = ["color", "palette", "color_range", "color_blend"];

const isOfColors = ({ name }: Parameter) => COLORS.includes(name);

export class Rules {
  private readonly parameters: ReadonlyMap<string, Parameter>;

  constructor(list: readonly Parameter[], private readonly schemes: Schemes) {
    this.parameters = new Map(list.map((parameter) => [parameter.name, parameter]));
  }

  get names(): ReadonlySet<string> {
    return new Set(this.parameters.keys());
  }

  /** Sets or resets a value, and resets those that it excludes. The result has the order of the document. */
  set(choices: Choices, name: string, value: string | undefined): Choices {
    const excluded = value === undefined ? [] : [...(this.parameters.get(name)?.insteadOf ?? [])];
    // Palette and range may not apply to the new scheme. Without colours there is nothing to blend.
    if (name === "color") excluded.push("palette", "color_range", ...(value === undefined ? ["color_blend"] : []));
    const now = new Map([...choices].filter(([other]) => other !== name && !excluded.includes(other)));
    if (value !== undefined) now.set(name, value);
    return new Map([...this.parameters.keys()].flatMap((key) => (now.has(key) ? [[key, now.get(key)!]] : [])));
  }

  /** Returns the parameters without which others cannot be used, so that a request would be in vain. */
  missing(choices: Choices): string[] {
    const [a, b, c] = ["paper_a", "paper_b", "paper_c"].map((name) => choices.has(name));
    if (b) return a || c ? [] : [choices.get("surface") === "inverse-square" ? "paper_c" : "paper_a"];
    return a || c ? ["paper_b"] : [];
  }

  /** Returns true if the colours belong to vertices, so that they come with the mesh. */
  coloursVertices(choices: Choices): boolean {
    const scheme = choices.get("color") ?? "none";
    if (scheme === "none") return false;
    const isOfAtoms = scheme.startsWith("uniform:") || this.schemes.ofAtoms.has(scheme);
    return !isOfAtoms || choices.get("color_blend") === "smooth";
  }

  /** Returns the values that affect the shape. */
  shape(choices: Choices): Choices {
    return this.chosen(choices, (parameter) => parameter.format === "" && !isOfColors(parameter));
  }

  /** Returns the values that affect the displayed mesh. */
  mesh(choices: Choices): Choices {
    return this.coloursVertices(choices) ? this.chosen(choices, ({ format }) => format === "") : this.shape(choices);
  }

  /** Returns the values that neither the mesh nor the colours of atoms depend on. */
  others(choices: Choices): Choices {
    const isOfAtoms = choices.has("color") && !this.coloursVertices(choices);
    const mesh = this.mesh(choices);
    return new Map([...choices].filter(([name]) => !mesh.has(name) && !(isOfAtoms && COLORS.includes(name))));
  }

  /** Returns the values that apply to a file of `format`. */
  file(format: string, choices: Choices): Choices {
    const isApart = [...this.parameters.values()].some((parameter) => parameter.format === format);
    const isExcluded = (name: string) => (isApart && STORAGE.includes(name)) || (name === "instances" && !REPEATING.includes(format));
    return this.chosen(choices, ({ name, format: only }) => (only === "" && !isExcluded(name)) || only === format);
  }

  private chosen(choices: Choices, which: (parameter: Parameter) => boolean): Choices {
    return new Map([...choices].filter(([name]) => {
      const parameter = this.parameters.get(name);
      return parameter !== undefined && which(parameter);
    }));
  }
}
