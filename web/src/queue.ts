/** Requests of which only the latest one counts. */

interface Entry<T> {
  key: unknown;
  result: Promise<T>;
  abort: AbortController;
}

/** Results of one kind: the one on the screen, and the latest one. A new request cancels the one before. */
export class Slot<T> {
  private shown: Entry<T> | null = null;
  private pending: Entry<T> | null = null;

  /** Returns the result with this key. Calls `start` unless it is on the screen or was requested last. */
  request<K extends {}>(key: K, start: (key: K, signal: AbortSignal) => Promise<T>): Promise<T>;
  /** Returns null, and cancels the last request, if the key is null. */
  request<K extends {}>(key: K | null, start: (key: K, signal: AbortSignal) => Promise<T>): Promise<T | null>;
  request<K extends {}>(key: K | null, start: (key: K, signal: AbortSignal) => Promise<T>): Promise<T | null> {
    const { pending, shown } = this;
    if (pending && pending.key === key) return pending.result;
    this.cancel();
    if (key === null) return Promise.resolve(null);
    if (shown && shown.key === key) return shown.result;
    const abort = new AbortController();
    const entry: Entry<T> = { key, result: start(key, abort.signal), abort };
    this.pending = entry;
    // The same request may succeed later.
    entry.result.catch(() => this.pending === entry && this.cancel());
    return entry.result;
  }

  /** The result of the last request is on the screen. */
  commit(): void {
    this.shown = this.pending ?? this.shown;
    this.pending = null;
  }

  /** Cancels the last request unless its result is on the screen. */
  cancel(): void {
    this.pending?.abort.abort();
    this.pending = null;
  }
}

/** Time, ms, that a running request has before a dragged slider replaces it, so that intermediate meshes appear. */
const GRACE = 250;

/** `live` requests come from a slider that is being dragged; `since` is the time of the input, by the page's clock. */
export class Queue<R extends { live: boolean; since: number }> {
  private running: { request: R; abort: AbortController } | null = null;
  private next: R | null = null;
  private timer = 0;

  /**
   * `run` runs a request to its end; its signal is aborted once a later request supersedes it. `idle` is called when no
   * request is running.
   */
  constructor(
    private readonly run: (request: R, signal: AbortSignal) => Promise<void>,
    private readonly failed: (error: unknown, request: R) => void,
    private readonly idle: () => void,
  ) {}

  want(request: R): void {
    const { running } = this;
    clearTimeout(this.timer);
    this.next = request;
    const age = running && request.live && running.request.live ? performance.now() - running.request.since : GRACE;
    if (age >= GRACE) this.supersede();
    else this.timer = window.setTimeout(() => this.supersede(), GRACE - age);
  }

  /** Cancels the running request. */
  cancel(): void {
    clearTimeout(this.timer);
    this.next = null;
    this.running?.abort.abort();
    if (this.running) this.idle();
    this.running = null;
  }

  private supersede(): void {
    clearTimeout(this.timer);
    const request = this.next;
    this.next = null;
    if (!request) return;
    this.running?.abort.abort();
    const mine = (this.running = { request, abort: new AbortController() });
    void this.follow(mine);
  }

  private async follow(mine: { request: R; abort: AbortController }): Promise<void> {
    try {
      await this.run(mine.request, mine.abort.signal);
    } catch (error) {
      // If a later request is waiting, this one is superseded already.
      if (this.running === mine && !this.next) this.failed(error, mine.request);
    }
    if (this.running !== mine) return;
    this.running = null;
    if (this.next) this.supersede();
    else this.idle();
  }
}
