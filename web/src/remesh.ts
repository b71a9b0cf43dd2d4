/** Meshes on request, the latest one wins: what was asked for before is cancelled, here and in the service. */

import { bytesOf } from "./api/bytes";
import type { Client } from "./api/client";
import { fetchFile, type Progress } from "./api/jobs";
import type { Source } from "./api/structures";
import type { Choices } from "./request";

export interface Wish {
  source: Source;
  /** Everything that was set when it was asked for; a preview replaces the spacing. */
  choices: Choices;
  /** The address of the mesh. */
  path: string;
  /** The spacing of a preview, Å; none: it is what was asked for. */
  preview?: number;
  /** A slider is being dragged: more will follow. */
  live: boolean;
  /** When it was wished for, by the page's clock. */
  since: number;
}

export interface Delivery {
  wish: Wish;
  /** When its head and its last byte had come, by the page's clock. */
  answered: number;
  received: number;
  bytes: ArrayBuffer;
  headers: Headers;
  /** Aborted once a later request supersedes this one, which must not be shown then. */
  signal: AbortSignal;
}

export interface Listener {
  /** Nothing was on its way, and now something is. */
  begin(wish: Wish): void;
  progress: Progress;
  /** A mesh is there. What comes while it is being shown waits. */
  show(delivery: Delivery): Promise<void>;
  failed(error: unknown, wish: Wish): void;
  /** Nothing is on its way any more. */
  idle(): void;
}

/** While a slider is dragged, a mesh on its way is given this long, ms, so that something is seen between its moves. */
const GRACE = 250;

export class Remesher {
  private current: { wish: Wish; abort: AbortController } | null = null;
  private next: Wish | null = null;
  private timer = 0;

  constructor(private readonly client: Client, private readonly listener: Listener) {}

  want(wish: Wish): void {
    const current = this.current;
    if (!current) return this.start(wish);
    if (current.wish.path === wish.path && current.wish.preview === wish.preview) {
      this.next = null;
      return;
    }
    const age = performance.now() - current.wish.since;
    if (wish.live && current.wish.live && age < GRACE) {
      this.next = wish;
      clearTimeout(this.timer);
      this.timer = window.setTimeout(() => this.supersede(), GRACE - age);
      return;
    }
    this.next = wish;
    this.supersede();
  }

  /** Cancels what is on its way. */
  cancel(): void {
    this.next = null;
    clearTimeout(this.timer);
    this.current?.abort.abort();
    if (this.current) this.listener.idle();
    this.current = null;
  }

  private supersede(): void {
    clearTimeout(this.timer);
    const wish = this.next;
    this.next = null;
    if (!wish) return;
    this.current?.abort.abort();
    this.start(wish);
  }

  private start(wish: Wish): void {
    const mine = { wish, abort: new AbortController() };
    this.current = mine;
    this.listener.begin(wish);
    void this.run(mine);
  }

  private async run(mine: { wish: Wish; abort: AbortController }): Promise<void> {
    const { wish, abort } = mine;
    const isLatest = () => this.current === mine;
    try {
      const reply = await fetchFile(this.client, wish.path, abort.signal, (job) => isLatest() && this.listener.progress(job));
      const answered = performance.now();
      const bytes = await bytesOf(reply);
      const received = performance.now();
      if (isLatest()) await this.listener.show({ wish, answered, received, bytes, headers: reply.headers, signal: abort.signal });
    } catch (error) {
      // A later request is waiting, so this one is superseded already.
      if (isLatest() && !this.next) this.listener.failed(error, wish);
    }
    if (!isLatest()) return;
    this.current = null;
    if (this.next) this.supersede();
    else this.listener.idle();
  }
}
