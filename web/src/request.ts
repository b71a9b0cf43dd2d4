/** What is asked for: a structure and the parameters that somebody has set, as an address and as a line for the shell. */

import type { Source } from "./api/structures";

/** Parameters that were set, by name; all others are at their defaults. */
export type Choices = ReadonlyMap<string, string>;

export function query(choices: Choices, more: Record<string, string> = {}): string {
  const pairs = new Map([...choices, ...Object.entries(more)]);
  const text = [...pairs].map(([name, value]) => `${encodeURIComponent(name)}=${encodeURIComponent(value).replaceAll("%2C", ",")}`).join("&");
  return text ? `?${text}` : "";
}

/** The address of a file that is made of a structure. */
export function surface(source: Source, extension: string, choices: Choices, more: Record<string, string> = {}): string {
  return `${source.path}/surface.${extension}${query(choices, more)}`;
}

/** What is drawn: every vertex with its atom, so that the pointer finds out whose it is. */
export function drawn(source: Source, choices: Choices, resolution?: number): string {
  if (resolution === undefined) return surface(source, "glb", choices, { atom_ids: "true" });
  // A preview sets the spacing in its own way.
  const rest = new Map([...choices].filter(([name]) => !["resolution", "detail", "max_triangles"].includes(name)));
  return surface(source, "glb", rest, { atom_ids: "true", resolution: String(resolution) });
}

const quoted = (text: string) => (/^[\w./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** The same from a shell, without anything that was done here before. */
export function curl(source: Source, format: string, choices: Choices, origin: string, key: boolean): string {
  const header = key ? ' -H "X-Api-Key: $MOLMESH_KEY"' : "";
  const out = `-o ${quoted(`${stem(source)}.${format}`)}`;
  if (source.path.startsWith("/v1/pdb/")) return `curl -sS${header} ${quoted(origin + surface(source, format, choices))} ${out}`;
  const address = quoted(`${origin}/v1/meshes${query(choices, format === "glb" ? {} : { format })}`);
  const sample = source.file === SAMPLE ? `curl -sS ${origin}/${SAMPLE} -o ${SAMPLE}\n` : "";
  return `${sample}curl -sS${header} --data-binary @${quoted(source.file || "structure.cif")} ${address} ${out}`;
}

/** The bundled structure. */
export const SAMPLE = "sample.pdb";

/** A file name without an extension. */
export function stem(source: Source): string {
  return (source.summary?.id ?? source.name).replaceAll(/[^\w.-]+/g, "_").replace(/\.(pdb|ent|cif|mmcif|bcif)?(\.gz|\.zst)?$/i, "").toLowerCase() || "surface";
}

/** What the page's own address says: parameters, and what they are for, so that reloading and sharing keep them. */
export function readAddress(known: ReadonlySet<string>): { choices: Map<string, string>; pdb: string; structure: string } {
  const pairs = new URLSearchParams(location.search);
  const choices = new Map([...pairs].filter(([name, value]) => known.has(name) && value !== ""));
  return { choices, pdb: pairs.get("pdb") ?? "", structure: pairs.get("structure") ?? "" };
}

export function writeAddress(source: Source | null, choices: Choices): void {
  const name: Record<string, string> = {};
  if (source?.path.startsWith("/v1/pdb/")) name["pdb"] = decodeURIComponent(source.path.slice("/v1/pdb/".length));
  else if (source && source.file !== SAMPLE) name["structure"] = source.path.slice("/v1/structures/".length);
  history.replaceState(null, "", location.pathname + query(new Map(Object.entries(name)), Object.fromEntries(choices)));
}
