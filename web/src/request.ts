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

/** The address of a mesh to show: every vertex with its atom, so that the pointer finds out whose it is. */
export function drawn(source: Source, choices: Choices): string {
  return surface(source, "glb", choices, { atom_ids: "true" });
}

/** Choices of a preview, which sets the spacing in its own way. */
export function coarser(choices: Choices, resolution: number): Choices {
  const rest = [...choices].filter(([name]) => !["resolution", "detail", "max_triangles"].includes(name));
  return new Map([...rest, ["resolution", String(resolution)]]);
}

const quoted = (text: string) => (/^[\w./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** The same from a shell, without anything that was done here before. */
export function curl(source: Source, format: string, choices: Choices, origin: string, key: boolean): string {
  const header = key ? ' -H "X-Api-Key: $MOLMESH_KEY"' : "";
  const out = `-o ${quoted(`${stem(source)}.${format}`)}`;
  if (source.path.startsWith("/v1/pdb/")) return `curl -sS${header} ${quoted(origin + surface(source, format, choices))} ${out}`;
  const address = quoted(`${origin}/v1/meshes${query(choices, format === "glb" ? {} : { format })}`);
  const sample = source.isSample ? `curl -sS ${origin}/${SAMPLE} -o ${SAMPLE}\n` : "";
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

/** The page's own address for a structure and what is set. */
export function addressOf(source: Source, choices: Choices): string {
  const name: Record<string, string> = {};
  if (source.path.startsWith("/v1/pdb/")) name["pdb"] = decodeURIComponent(source.path.slice("/v1/pdb/".length));
  else if (!source.isSample) name["structure"] = source.path.slice("/v1/structures/".length);
  return location.pathname + query(new Map(Object.entries(name)), Object.fromEntries(choices));
}

/** The address that the page has now, in the form of `addressOf`. */
export const currentAddress = () => location.pathname + location.search;

/** Gives the page another address: `push` as a new entry of the history, otherwise in place of the present one. */
export function writeAddress(address: string, push: boolean): void {
  if (address === currentAddress()) return;
  if (push) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
}
