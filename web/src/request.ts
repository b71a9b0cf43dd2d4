/** A structure with the parameters that the user has set, as a URL and as a shell command. */

import type { Source } from "./api/structures";
import type { Choices } from "./rules";
import { transparencyOf } from "./scene/context";
import { cameraText, parseCamera } from "./scene/camera";
import type { Display, View } from "./view";

export function query(choices: Choices, more: Record<string, string> = {}): string {
  const pairs = new Map([...choices, ...Object.entries(more)]);
  const text = [...pairs].map(([name, value]) => `${encodeURIComponent(name)}=${encodeURIComponent(value).replaceAll("%2C", ",")}`).join("&");
  return text ? `?${text}` : "";
}

/** Returns the path of a file made from a structure. */
export function surface(source: Source, extension: string, choices: Choices, more: Record<string, string> = {}): string {
  return `${source.path}/surface.${extension}${query(choices, more)}`;
}

/**
 * Returns the path of a mesh for display, with an atom id per vertex for atom selection. The mesh is compressed unless
 * the user has chosen otherwise or the browser has no WebAssembly, which the decoder needs.
 */
export function drawn(source: Source, choices: Choices): string {
  const more: Record<string, string> = { atom_ids: "true" };
  if (!choices.has("compress") && typeof WebAssembly !== "undefined") more["compress"] = "meshopt";
  return surface(source, "glb", choices, more);
}

/** Returns the parameters of a preview with the given grid spacing, Å. */
export function coarser(choices: Choices, resolution: number): Choices {
  const rest = [...choices].filter(([name]) => !["resolution", "detail", "max_triangles"].includes(name));
  return new Map([...rest, ["resolution", String(resolution)]]);
}

const quoted = (text: string) => (/^[\w./:=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

/** Start of a shell command. It fails with the problem document if the server returns an error. */
const CURL = "curl -sS --fail-with-body";

/** Returns a shell command for the same file that does not depend on earlier requests of the page. */
export function curl(source: Source, format: string, choices: Choices, origin: string, key: boolean): string {
  const header = key ? ' -H "X-Api-Key: $MOLMESH_KEY"' : "";
  const out = `-o ${quoted(`${stem(source)}.${format}`)}`;
  if (source.path.startsWith("/v1/pdb/")) return `${CURL}${header} ${quoted(origin + surface(source, format, choices))} ${out}`;
  const address = quoted(`${origin}/v1/meshes${query(choices, format === "glb" ? {} : { format })}`);
  const sample = source.isSample ? `${CURL} ${origin}/${SAMPLE} -o ${SAMPLE}\n` : "";
  return `${sample}${CURL}${header} --data-binary @${quoted(source.file || "structure.cif")} ${address} ${out}`;
}

/** The bundled structure. */
export const SAMPLE = "sample.pdb";

/** Keeps meshes out of the browser's cache: they are large and made in milliseconds. */
export const UNCACHED: RequestInit = { cache: "no-store" };

/** Returns a file name without an extension. */
export function stem(source: Source): string {
  return (source.summary?.id ?? source.name).replaceAll(/[^\w.-]+/g, "_").replace(/\.(pdb|ent|cif|mmcif|bcif)?(\.gz|\.zst)?$/i, "").toLowerCase() || "surface";
}

/** Reads structure, parameters and display from the page's address, which preserves them for reloading and sharing. */
export function readAddress(known: ReadonlySet<string>): { choices: Choices; display: Display; pdb: string; structure: string } {
  const pairs = new URLSearchParams(location.search);
  const text = (name: string) => pairs.get(name) ?? "";
  const choices = new Map([...pairs].filter(([name, value]) => known.has(name) && value !== ""));
  const display = {
    sticks: text("sticks") === "true",
    transparency: transparencyOf(text("transparency")),
    hidden: text("hide").split(",").filter(Boolean).map(unescaped),
    camera: cameraText(parseCamera(text("camera"))),
  };
  return { choices, display, pdb: text("pdb"), structure: text("structure") };
}

function unescaped(name: string): string {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** Returns the page's address for a view. */
export function addressOf({ source, choices, display }: View): string {
  const pairs: Record<string, string> = {};
  if (source.path.startsWith("/v1/pdb/")) pairs["pdb"] = decodeURIComponent(source.path.slice("/v1/pdb/".length));
  else if (!source.isSample) pairs["structure"] = source.path.slice("/v1/structures/".length);
  Object.assign(pairs, Object.fromEntries(choices));
  if (display.sticks) pairs["sticks"] = "true";
  if (display.transparency) pairs["transparency"] = String(display.transparency);
  // Names may contain commas.
  if (display.hidden.length) pairs["hide"] = display.hidden.map(encodeURIComponent).join(",");
  if (display.camera) pairs["camera"] = display.camera;
  return location.pathname + query(new Map(Object.entries(pairs)));
}

/** Returns the current address of the page, in the form of `addressOf`. */
export const currentAddress = () => location.pathname + location.search;

/** Changes the page's address: with `push` as a new history entry, otherwise in place of the current one. */
export function writeAddress(address: string, push: boolean): void {
  if (address === currentAddress()) return;
  if (push) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
}
