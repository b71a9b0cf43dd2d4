/** Mesh parameters, read from the OpenAPI document of the service. */

export type Kind = "number" | "integer" | "boolean" | "choice" | "text";

export interface Parameter {
  name: string;
  doc: string;
  kind: Kind;
  /** Bounds of numbers. */
  min: number;
  max: number;
  /** Range of a slider. */
  usual: [number, number];
  unit: string;
  /** Default value; undefined if it depends on other parameters. */
  fallback: string | undefined;
  /** Default value in words. */
  fallbackWords: string;
  /** Values of choices. */
  values: string[];
  /** The only output format that it applies to; empty if it applies to all. */
  format: string;
  /** Parameters that exclude it. */
  insteadOf: string[];
}

interface Reference {
  $ref?: string;
}

interface Schema extends Reference {
  type?: string | string[];
  title?: string;
  default?: unknown;
  minimum?: number;
  maximum?: number;
  enum?: string[];
}

interface Described extends Reference {
  name: string;
  in: string;
  description?: string;
  schema?: Schema;
  "x-control"?: { usual?: [number, number]; unit?: string; instead_of?: string[]; format?: string };
}

export interface OpenApi {
  paths: Record<string, Record<string, { operationId?: string; parameters?: Described[] }>>;
  components?: Record<string, Record<string, unknown>>;
}

/** Follows a reference into `components`. */
function resolved<T extends Reference>(api: OpenApi, value: T): T {
  const [kind, name] = value.$ref?.split("/").slice(-2) ?? [];
  return kind && name ? (api.components?.[kind]?.[name] as T) : value;
}

function described(api: OpenApi, id = "createMesh"): Described[] {
  const operations = Object.values(api.paths).flatMap((path) => Object.values(path));
  const operation = operations.find(({ operationId }) => operationId === id);
  return (operation?.parameters ?? []).map((parameter) => resolved(api, parameter)).filter((parameter) => parameter.in === "query");
}

/**
 * Returns the parameters of the form in document order. The buttons that download files choose `format`, and the page
 * sends no map, to which `color_offset` applies. The viewer chooses tiles.
 */
export function parametersOf(api: OpenApi): Parameter[] {
  const isOfForm = ({ name }: Described) => !["format", "color_offset", "tile"].includes(name);
  return described(api).filter(isOfForm).map((parameter) => parameterOf(api, parameter));
}

/** Returns the names of the parameters that apply to tilesets. */
export function tilesetParametersOf(api: OpenApi): ReadonlySet<string> {
  return new Set(described(api, "showTileset").map(({ name }) => name));
}

/** Returns the output formats, by file name extension. */
export function formatsOf(api: OpenApi): string[] {
  const format = described(api).find((parameter) => parameter.name === "format")?.schema;
  return (format && resolved(api, format).enum) ?? ["glb"];
}

/** Colour schemes and palettes of the service. */
export interface Schemes {
  /** Values of the parameter `color`, except `map`, because the page sends no map. */
  all: string[];
  /** Schemes by properties of atoms. The others need a mesh with colours. */
  ofAtoms: ReadonlySet<string>;
  palettes: string[];
}

export function schemesOf(api: OpenApi): Schemes {
  const schema = (name: string, operation?: string): Schema => {
    const found = described(api, operation).find((parameter) => parameter.name === name)?.schema;
    return found ? resolved(api, found) : {};
  };
  const words = ({ title }: Schema) => title?.split(", ") ?? [];
  const ofAtoms = new Set(words(schema("scheme", "colorAtoms")));
  const all = words(schema("color")).filter((scheme) => scheme !== "map");
  return { all, ofAtoms, palettes: schema("palette").enum ?? [] };
}

function kindOf(schema: Schema): Kind {
  const type = Array.isArray(schema.type) ? schema.type.find((t) => t !== "null") : schema.type;
  if (type === "boolean" || type === "number" || type === "integer") return type;
  return schema.enum ? "choice" : "text";
}

function parameterOf(api: OpenApi, parameter: Described): Parameter {
  const schema = resolved(api, parameter.schema ?? {});
  const text = parameter.description ?? "";
  const min = schema.minimum ?? Number.NEGATIVE_INFINITY;
  const max = schema.maximum ?? Number.POSITIVE_INFINITY;
  const { usual: span, unit, instead_of: insteadOf, format } = parameter["x-control"] ?? {};
  const value = schema.default;
  const words = / Default: (.*)\.$/s.exec(text)?.[1];
  return {
    name: parameter.name,
    // The form shows the range and the default beside the control.
    doc: text.replace(/ (Range|Value|Default): .*$/s, ""),
    kind: kindOf(schema),
    min,
    max,
    usual: span ?? usual(min, max, Number(value)),
    unit: unit ?? "",
    fallback: value === undefined || value === null ? undefined : String(value),
    fallbackWords: words ?? (value === undefined ? "absent" : String(value)),
    values: schema.enum ?? [],
    format: format ?? "",
    insteadOf: insteadOf ?? [],
  };
}

/** Returns the range of a slider without `usual`: the bounds, or three octaves around the default if they are wide. */
function usual(min: number, max: number, value: number): [number, number] {
  const wide = !Number.isFinite(min) || !Number.isFinite(max) || (min > 0 ? max / min > 100 : max - min > 1000);
  if (!wide) return [min, max];
  const middle = Number.isFinite(value) && value > 0 ? value : Math.max(min, 1);
  return [Math.max(min, middle / 8), Math.min(max, middle * 8)];
}
