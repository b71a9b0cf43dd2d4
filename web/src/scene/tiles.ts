/** Tiles of a tileset: loads those that the view needs, coarse ones first, within a limit of memory. */

import { type InstancedMesh, type Material, Mesh, type Object3D, type PerspectiveCamera, Vector2, type WebGLRenderer } from "three";
import { MeshoptDecoder } from "three/examples/jsm/libs/meshopt_decoder.module.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import type { Tile } from "3d-tiles-renderer/core";
import { TilesRenderer } from "3d-tiles-renderer/three";
import { ImplicitTilingPlugin } from "3d-tiles-renderer/core/plugins";
import { transformsOf } from "./load";

/** Minimum error target: grid spacing on the screen, in pixels, above which finer tiles replace a tile. */
const MIN_ERROR = 4;
/** Maximum number of visible triangles. Above it, the error target grows by the factor `COARSER`. */
const MAX_VISIBLE_TRIANGLES = 2e6;
const COARSER = 1.25;
/** Limits of the memory of tiles, bytes. Above the second one, tiles out of view are removed down to the first. */
const MEMORY = [120e6, 180e6] as const;
/** Concurrent requests: as many as browsers send to a server over HTTP/1.1. */
const REQUESTS = 6;

/** State of the tiles. */
export interface TilesState {
  /** Visible tiles. */
  tiles: number;
  /** Triangles of the visible tiles. */
  triangles: number;
  /** Finest and coarsest grid spacing of the visible tiles, Å. */
  spacings: [number, number];
  /** Memory of all loaded tiles, bytes. */
  bytes: number;
  /** True while tiles are loading. */
  loading: boolean;
}

export interface TilesListener {
  /** Called with each tile that was loaded. */
  loaded(meshes: Mesh[]): void;
  /** Called when the scene needs to be drawn again. */
  invalidate(): void;
  failed(error: unknown): void;
}

/** Sends a request for a tile. */
export type FetchTile = (url: string, signal: AbortSignal) => Promise<Response>;

export class Tiles {
  private readonly renderer: TilesRenderer;
  /** Loaded tiles with their meshes. */
  private readonly loaded = new Map<Tile, Mesh[]>();
  private loading = false;

  /** Opens the tileset at `url`. */
  constructor(url: string, fetchTile: FetchTile, private readonly listener: TilesListener) {
    const tiles = (this.renderer = new TilesRenderer(url));
    tiles.registerPlugin(new ImplicitTilingPlugin());
    tiles.registerPlugin({ fetchData: (address: string, { signal }: { signal: AbortSignal }) => fetchTile(address, signal) });
    tiles.manager.addHandler(/\.(gltf|glb)$/, new GLTFLoader(tiles.manager).setMeshoptDecoder(MeshoptDecoder));
    tiles.errorTarget = MIN_ERROR;
    [tiles.lruCache.minBytesSize, tiles.lruCache.maxBytesSize] = MEMORY;
    tiles.downloadQueue.maxJobsPerOrigin = REQUESTS;
    tiles.addEventListener("load-model", ({ scene, tile }) => {
      meshesOf(scene).forEach(expand);
      const meshes = meshesOf(scene);
      this.loaded.set(tile, meshes);
      for (const { material } of meshes) (material as Material).dispose();
      listener.loaded(meshes);
    });
    tiles.addEventListener("dispose-model", ({ tile }) => this.loaded.delete(tile));
    tiles.addEventListener("tiles-load-start", () => (this.loading = true));
    tiles.addEventListener("tiles-load-end", () => {
      this.loading = false;
      listener.invalidate();
    });
    tiles.addEventListener("needs-update", () => listener.invalidate());
    tiles.addEventListener("load-error", ({ error }) => listener.failed(error));
  }

  /** Object of the scene with the visible tiles. */
  get group(): Object3D {
    return this.renderer.group;
  }

  /** Returns the meshes of all loaded tiles. */
  get all(): Mesh[] {
    return [...this.loaded.values()].flat();
  }

  /** Returns the meshes of the visible tiles. */
  get meshes(): Mesh[] {
    return this.shown.flatMap(([, meshes]) => meshes);
  }

  get state(): TilesState {
    const spacings = this.shown.map(([{ geometricError }]) => geometricError);
    return {
      tiles: spacings.length,
      triangles: this.triangles,
      spacings: [Math.min(...spacings), Math.max(...spacings)],
      bytes: [...this.loaded.keys()].reduce((sum, tile) => sum + this.renderer.lruCache.getMemoryUsage(tile), 0),
      loading: this.loading,
    };
  }

  /** Returns the visible tiles that have a surface, with their meshes. */
  private get shown(): [Tile, Mesh[]][] {
    const { visibleTiles } = this.renderer;
    return [...this.loaded].filter(([tile, meshes]) => meshes.length > 0 && visibleTiles.has(tile));
  }

  /** Selects the tiles for the view of `camera`, and begins to load those that are missing. */
  update(camera: PerspectiveCamera, drawn: WebGLRenderer): void {
    const { renderer } = this;
    renderer.setCamera(camera);
    // Of the canvas without device pixels: detail beyond them costs more than it shows.
    renderer.setResolution(camera, drawn.getSize(new Vector2()));
    this.balance();
    renderer.update();
  }

  /** Makes the tiles coarser while there are too many triangles, and finer again while there are few. */
  private balance(): void {
    const { renderer, triangles } = this;
    const before = renderer.errorTarget;
    if (triangles > MAX_VISIBLE_TRIANGLES) renderer.errorTarget *= COARSER;
    // A level has about four times the triangles of the one before.
    else if (triangles < MAX_VISIBLE_TRIANGLES / 4 && !this.loading) renderer.errorTarget = Math.max(MIN_ERROR, before / COARSER);
    if (renderer.errorTarget !== before) this.listener.invalidate();
  }

  /** Returns the number of triangles of the visible tiles. */
  private get triangles(): number {
    return this.meshes.reduce((sum, { geometry }) => sum + (geometry.getIndex()?.count ?? 0) / 3, 0);
  }

  /** Loads tiles again that could not be loaded. */
  retry(): void {
    this.renderer.resetFailedTiles();
    this.listener.invalidate();
  }

  dispose(): void {
    this.renderer.dispose();
  }
}

function meshesOf(object: Object3D): Mesh[] {
  const meshes: Mesh[] = [];
  object.traverse((child) => {
    // A layer of depths is a child of its mesh.
    if ((child as Mesh).isMesh && !(child.parent as Mesh | null)?.isMesh) meshes.push(child as Mesh);
  });
  return meshes;
}

/** Replaces a mesh with instances by one mesh for each instance, because surfaces are picked and drawn one by one. */
function expand(mesh: Mesh): void {
  if (!(mesh as InstancedMesh).isInstancedMesh) return;
  mesh.updateMatrix();
  for (const matrix of transformsOf(mesh, mesh.matrix)) {
    const one = new Mesh(mesh.geometry, mesh.material);
    one.matrix.copy(matrix);
    one.matrixAutoUpdate = false;
    one.userData = mesh.userData;
    mesh.parent?.add(one);
  }
  mesh.removeFromParent();
}
