/** Queue of mesh requests. A new request cancels the running one, here and in the service. */

import { bytesOf } from "./api/bytes";
import type { JobDocument } from "../client/dist/api";
import type { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import type { Source } from "./api/structures";
import type { DisplayState } from "./display";
import { isLarge, type TilesetPaths } from "./large";
import { type Choices, UNCACHED } from "./request";

export interface MeshRequest {
  source: Source;
  /** All parameters at the time of the request; a preview replaces the grid spacing. */
  choices: Choices;
  /** Display of the surface; null if it does not change. */
  display: DisplayState | null;
  /** Path of the mesh. */
  path: string;
  /** Grid spacing of a preview, Å; undefined for a full mesh. */
  preview?: number;
  /** True while a slider is dragged and more requests will follow. */
  live: boolean;
  /** Time of the input, by the page's clock. */
  since: number;
}

export interface Delivery {
  request: MeshRequest;
  /** Times of the response head and of the last byte, by the page's clock. */
  answered: number;
  received: number;
  bytes: ArrayBuffer;
  headers: Headers;
  /** Tileset of which the mesh is the coarsest tile; null for a whole mesh. */
  tileset: TilesetPaths | null;
  /** Aborted once a later request supersedes this one, which must not be shown then. */
  signal: AbortSignal;
}

export interface Listener {
  /** Called when a request starts. */
  begin(request: MeshRequest): void;
  /** Returns the tileset of a surface that may be too large for one file; otherwise null. */
  tileset(request: MeshRequest): TilesetPaths | null;
  /** Called with the state of the job of the running request. */
  progress(job: JobDocument): void;
  /** Shows a received mesh. Later requests wait until it is shown. */
  show(delivery: Delivery): Promise<void>;
  failed(error: unknown, request: MeshRequest): void;
  /** Called when no request is running. */
  idle(): void;
}

/** Time, ms, that a running request has before a dragged slider replaces it, so that intermediate meshes appear. */
const GRACE = 250;

export class Remesher {
  private current: { request: MeshRequest; abort: AbortController } | null = null;
  private next: MeshRequest | null = null;
  private timer = 0;

  constructor(private readonly client: Client, private readonly listener: Listener) {}

  want(request: MeshRequest): void {
    const current = this.current;
    if (!current) return this.start(request);
    if (current.request.path === request.path && current.request.preview === request.preview) {
      this.next = null;
      return;
    }
    const age = performance.now() - current.request.since;
    if (request.live && current.request.live && age < GRACE) {
      this.next = request;
      clearTimeout(this.timer);
      this.timer = window.setTimeout(() => this.supersede(), GRACE - age);
      return;
    }
    this.next = request;
    this.supersede();
  }

  /** Cancels the running request. */
  cancel(): void {
    this.next = null;
    clearTimeout(this.timer);
    this.current?.abort.abort();
    if (this.current) this.listener.idle();
    this.current = null;
  }

  private supersede(): void {
    clearTimeout(this.timer);
    const request = this.next;
    this.next = null;
    if (!request) return;
    this.current?.abort.abort();
    this.start(request);
  }

  private start(request: MeshRequest): void {
    const mine = { request, abort: new AbortController() };
    this.current = mine;
    this.listener.begin(request);
    void this.run(mine);
  }

  private async run(mine: { request: MeshRequest; abort: AbortController }): Promise<void> {
    const { request, abort } = mine;
    const isLatest = () => this.current === mine;
    try {
      const onProgress = (job: JobDocument) => isLatest() && this.listener.progress(job);
      const fetching = (path: string) => this.client.file(path, { signal: abort.signal, onProgress, init: UNCACHED });
      let tileset = request.preview === undefined ? this.listener.tileset(request) : null;
      let reply = tileset && (await fetching(tileset.root).catch(withoutTiles));
      // The number of atoms is known only now. The service has read them, so the whole surface takes little longer.
      if (!reply || !isLarge(Number(reply.headers.get("molmesh-atoms")), request.choices)) {
        tileset = null;
        reply = await fetching(request.path);
      }
      const answered = performance.now();
      const bytes = await bytesOf(reply);
      const received = performance.now();
      if (isLatest()) await this.listener.show({ request, answered, received, bytes, headers: reply.headers, tileset, signal: abort.signal });
    } catch (error) {
      // A later request is waiting, so this one is superseded already.
      if (isLatest() && !this.next) this.listener.failed(error, request);
    }
    if (!isLatest()) return;
    this.current = null;
    if (this.next) this.supersede();
    else this.listener.idle();
  }
}

/**
 * Returns null for the error of a service that cannot keep the index of a tileset, or of a coarse mesh that misses the
 * surface. Throws any other error.
 */
function withoutTiles(error: unknown): null {
  if (error instanceof Problem && error.is("too-much-memory", "no-surface")) return null;
  throw error;
}
