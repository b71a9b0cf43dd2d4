/** Surfaces that are too large for one file. They are shown in tiles, which are loaded as the view needs them. */

import type { Client } from "../client/src/client";
import { asProblem } from "./api/problem";
import type { Source } from "./api/structures";
import { query, surface } from "./request";
import type { Choices } from "./rules";
import type { FetchTile } from "./scene/tiles";

/** Number of triangles above which a surface is shown in tiles. */
const MAX_FILE_TRIANGLES = 3e6;
/** Approximate number of triangles per atom at 0.5 Å. */
const TRIANGLES_PER_ATOM = 100;
/** Attempts to fetch a tile from a busy server, and the pause before the second one, ms. Later pauses are longer. */
const ATTEMPTS = 5;
const PAUSE = 500;

/** Paths of a tileset and of its coarsest mesh. */
export interface TilesetPaths {
  document: string;
  root: string;
}

/**
 * Returns the tileset of a surface that may have too many triangles for one file; otherwise null, also if a parameter
 * is not among `applicable`, those of tilesets. `detail` limits the number of triangles.
 */
export function tilesetOf(source: Source, choices: Choices, applicable: ReadonlySet<string>): TilesetPaths | null {
  const applies = [...choices.keys()].every((name) => applicable.has(name) && name !== "detail") && choices.get("model") !== "all";
  // The decoder of tiles needs WebAssembly.
  if (!applies || typeof WebAssembly === "undefined") return null;
  const repeats = choices.get("instances") === "true";
  // Copies of an assembly have more atoms than the file.
  if (source.atoms !== undefined && (repeats || !choices.has("assembly")) && !isLarge(source.atoms, choices)) return null;
  const more = { atom_ids: "true", compress: choices.get("compress") ?? "meshopt" };
  return { document: `${source.path}/tileset.json${query(choices, more)}`, root: surface(source, "glb", choices, { ...more, tile: "0/0/0/0" }) };
}

/** Returns the paths of the tileset at `url`, of a service or a folder; null for another address. */
export function tilesetAt(url: string): TilesetPaths | null {
  const root = new URL(url, document.baseURI);
  if (!root.pathname.endsWith("/tileset.json")) return null;
  if (/\/v1\/(pdb|structures)\/[^/]+\/tileset\.json$/.test(root.pathname)) {
    root.pathname = root.pathname.replace(/tileset\.json$/, "surface.glb");
    root.searchParams.set("tile", "0/0/0/0");
    if (!root.searchParams.has("compress")) root.searchParams.set("compress", "meshopt");
  } else root.pathname = root.pathname.replace(/tileset\.json$/, "0/0/0/0.glb");
  return { document: new URL(url, document.baseURI).href, root: root.href };
}

/** Returns true if the surface of so many atoms is shown in tiles. */
export function isLarge(atoms: number, choices: Choices): boolean {
  const spacing = Number(choices.get("resolution") ?? 0.5);
  return TRIANGLES_PER_ATOM * atoms * (0.5 / spacing) ** 2 > MAX_FILE_TRIANGLES;
}

/** Returns a function that fetches a tile, and tries again while the server is busy. */
export function tileFetcher(client: Client): FetchTile {
  return async (url, signal) => {
    for (let attempt = 1; ; attempt += 1) {
      try {
        return await client.ask(url, { signal });
      } catch (error) {
        if (signal.aborted || asProblem(error).document.status !== 503 || attempt === ATTEMPTS) throw error;
        await new Promise((resolve) => setTimeout(resolve, PAUSE * attempt));
      }
    }
  };
}
