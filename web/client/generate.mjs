// Writes dist/api.d.ts, the types of the service: schemas and parameters of the OpenAPI document, ../../openapi.yaml.
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { parse } from "yaml";

const here = new URL("./", import.meta.url);
const { components, paths } = parse(readFileSync(new URL("../../openapi.yaml", here), "utf8"));
const operations = Object.fromEntries(Object.values(paths).flatMap((path) => Object.values(path)).map((operation) => [operation.operationId, operation]));
/** Query parameters of these operations become interfaces with these names. */
const queries = { MeshParameters: "createMesh", AreaParameters: "listAreas", AtomParameters: "listAtoms" };

const last = ($ref) => $ref.split("/").at(-1);
const comment = (text, indent = "") => (text ? `${indent}/** ${text.replaceAll("*/", "* /").split("\n").join(`\n${indent} * `)} */\n` : "");
const member = (name, schema, description, required) => `${comment(description, "  ")}  ${/^\w+$/.test(name) ? name : JSON.stringify(name)}${required ? "" : "?"}: ${type(schema)};\n`;
const members = ({ properties = {}, required = [] }) =>
  Object.entries(properties).map(([name, schema]) => member(name, schema, schema.description, required.includes(name))).join("");

/** Returns a schema as a TypeScript type. Throws on a keyword that it does not know. */
function type(schema) {
  if (schema.$ref) return last(schema.$ref);
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (schema.oneOf) return schema.oneOf.map(type).join(" | ");
  if (schema.allOf) return schema.allOf.map(type).join(" & ");
  if (Array.isArray(schema.type)) return schema.type.map((one) => type({ ...schema, type: one })).join(" | ");
  switch (schema.type) {
    case "null": case "boolean": case "number": return schema.type;
    case "integer": return "number";
    case "string": return schema.format === "binary" ? "Blob" : "string";
    case "array": return `Array<${type(schema.items)}>`;
    case "object": {
      if (schema.properties) return `{\n${members(schema)}}`;
      return `Record<string, ${schema.additionalProperties === true ? "unknown" : type(schema.additionalProperties)}>`;
    }
    case undefined: return "unknown";
    default: throw new Error(`unknown type: ${JSON.stringify(schema)}`);
  }
}

const schemas = Object.entries(components.schemas).map(([name, schema]) => {
  const open = schema.additionalProperties === true ? "  [name: string]: unknown;\n" : "";
  const isInterface = schema.type === "object" && schema.properties;
  return comment(schema.description) + (isInterface ? `export interface ${name} {\n${members(schema)}${open}}\n` : `export type ${name} = ${type(schema)};\n`);
});
const interfaces = Object.entries(queries).map(([name, id]) => {
  const parameters = operations[id].parameters.map(({ $ref }) => components.parameters[last($ref)]).filter((one) => one.in === "query");
  const lines = parameters.map((one) => member(one.name, one.schema, one.description, one.required));
  return `${comment(`Query parameters of the operation \`${id}\`.`)}export interface ${name} {\n${lines.join("")}}\n`;
});
mkdirSync(new URL("dist", here), { recursive: true });
writeFileSync(new URL("dist/api.d.ts", here), `// Generated from openapi.yaml by generate.mjs.\n\n${[...schemas, ...interfaces].join("\n")}`);
