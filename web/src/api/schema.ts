/** Parameters of a mesh, read from the OpenAPI document of the service. */

export type Kind = "number" | "integer" | "boolean" | "choice" | "set" | "text";

export interface Parameter {
  name: string;
  doc: string;
  kind: Kind;
  /** Bounds of numbers. */
  min: number;
  max: number;
  /** Range of the slider within the bounds. */
  usual: [number, number];
  unit: string;
  /** Default value; undefined if it depends on other parameters. */
  fallback: string | undefined;
  /** Default value in words. */
  fallbackWords: string;
  /** Permitted words of choices and sets. */
  values: string[];
  /** Description of permitted values. */
  expected: string;
  /** The only format that it applies to, such as `png`; empty for parameters of the mesh. */
  format: string;
  /** Parameters that exclude it. */
  insteadOf: string[];
}

interface Schema {
  type?: string | string[];
  title?: string;
  description?: string;
  default?: unknown;
  minimum?: number;
  maximum?: number;
  enum?: string[];
  items?: { enum?: string[] };
  "x-control"?: { usual?: [number, number]; unit?: string; instead_of?: string[]; format?: string };
}

interface Described {
  name: string;
  in: string;
  description?: string;
  schema?: Schema;
}

export interface OpenApi {
  paths: Record<string, Record<string, { operationId?: string; parameters?: Described[] }>>;
}

/** Parameters without a control: the URL determines the format, and the file contains the report. */
const ELSEWHERE = ["format", "report"];

function described(api: OpenApi): Described[] {
  const operations = Object.values(api.paths).flatMap((path) => Object.values(path));
  const mesh = operations.find((operation) => operation.operationId === "createMesh");
  return (mesh?.parameters ?? []).filter((parameter) => parameter.in === "query");
}

/** Returns every parameter, in the order of the document. */
export function parametersOf(api: OpenApi): Parameter[] {
  return described(api).filter((parameter) => !ELSEWHERE.includes(parameter.name)).map(parameterOf);
}

/** Returns the available formats by file extension. */
export function formatsOf(api: OpenApi): string[] {
  return described(api).find((parameter) => parameter.name === "format")?.schema?.enum ?? ["glb"];
}

function kindOf(schema: Schema): Kind {
  const type = Array.isArray(schema.type) ? schema.type.find((t) => t !== "null") : schema.type;
  if (type === "array") return schema.items?.enum ? "set" : "text";
  if (type === "boolean" || type === "number" || type === "integer") return type;
  return schema.enum ? "choice" : "text";
}

function parameterOf(parameter: Described): Parameter {
  const schema = parameter.schema ?? {};
  const min = schema.minimum ?? Number.NEGATIVE_INFINITY;
  const max = schema.maximum ?? Number.POSITIVE_INFINITY;
  const { usual: span, unit, instead_of: insteadOf, format } = schema["x-control"] ?? {};
  const value = schema.default;
  const words = /Default: (.*)\.$/s.exec(schema.description ?? "")?.[1];
  return {
    name: parameter.name,
    doc: parameter.description ?? "",
    kind: kindOf(schema),
    min,
    max,
    usual: span ?? usual(min, max, Number(value)),
    unit: unit ?? "",
    fallback: value === undefined || value === null ? undefined : String(value),
    fallbackWords: words ?? (value === undefined ? "absent" : String(value)),
    values: schema.enum ?? schema.items?.enum ?? [],
    expected: schema.title ?? "",
    format: format ?? "",
    insteadOf: insteadOf ?? [],
  };
}

/** Returns the range of a slider if the document does not state one: three octaves around the default. */
function usual(min: number, max: number, value: number): [number, number] {
  const wide = !Number.isFinite(min) || !Number.isFinite(max) || (min > 0 ? max / min > 100 : max - min > 1000);
  if (!wide) return [min, max];
  const middle = Number.isFinite(value) && value > 0 ? value : Math.max(min, 1);
  return [Math.max(min, middle / 8), Math.min(max, middle * 8)];
}
