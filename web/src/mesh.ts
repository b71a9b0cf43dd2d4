/** Everything that a viewer draws of a surface: its mesh, the colours of its atoms, and sticks of ligands. */

import type { JobDocument } from "../client/dist/api";
import type { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import { bytesOf } from "./api/bytes";
import type { AtomColors } from "./api/colors";
import type { TilesetPaths } from "./large";
import type { Ligands } from "./ligands";
import { load, type Loaded } from "./scene/load";
import { palette } from "./scene/material";
import type { Viewer } from "./scene/viewer";

export interface Mesh {
  loaded: Loaded;
  headers: Headers;
  /** Tileset of which the mesh is the coarsest tile; null for a whole mesh. */
  tileset: TilesetPaths | null;
  /** Times of the response head and of the last byte, by the page's clock. */
  answered: number;
  received: number;
}

export interface MeshRequest {
  path: string;
  /** Tileset of a surface that may be too large for one file; otherwise null. */
  tileset: TilesetPaths | null;
  /** Returns true if the surface, whose coarsest tile was received, is shown in tiles. */
  isLarge: (headers: Headers) => boolean;
  signal: AbortSignal;
  onProgress: (job: JobDocument) => void;
  init?: RequestInit;
}

export async function fetchMesh(client: Client, { path, tileset, isLarge, ...options }: MeshRequest): Promise<Mesh> {
  let reply = tileset && (await client.file(tileset.root, options).catch(withoutTiles));
  const tiles = reply && isLarge(reply.headers) ? tileset : null;
  // The service has read the atoms, so the whole surface takes little longer.
  if (!reply || !tiles) reply = await client.file(path, options);
  const answered = performance.now();
  const bytes = await bytesOf(reply);
  const received = performance.now();
  return { loaded: await load(bytes), headers: reply.headers, tileset: tiles, answered, received };
}

/**
 * Returns null for the error of a service that cannot keep the index of a tileset, or of a coarse mesh that misses the
 * surface. Throws any other error.
 */
function withoutTiles(error: unknown): null {
  if (error instanceof Problem && error.is("too-much-memory", "no-surface")) return null;
  throw error;
}

export interface Scene {
  mesh: Mesh;
  /** Colours of the atoms; null for the colours of the file if `usesFile`, otherwise for one colour. */
  colors: AtomColors | null;
  usesFile: boolean;
  ligands: Ligands | null;
}

/** Draws a scene in place of `previous` at once. Resets the view if `fresh`. Resolves with the time after its frame. */
export function draw(viewer: Viewer, scene: Scene, previous: Scene | null, fresh: boolean): Promise<number> {
  const { mesh, colors, usesFile, ligands } = scene;
  if (colors !== previous?.colors || usesFile !== previous.usesFile) {
    viewer.colour(colors && palette(colors.rgba), (colors?.rgba.length ?? 0) / 4, usesFile);
  }
  if (ligands !== previous?.ligands) viewer.showSticks(ligands?.geometry ?? null);
  return mesh === previous?.mesh ? viewer.drawn() : viewer.show(mesh.loaded, fresh);
}
