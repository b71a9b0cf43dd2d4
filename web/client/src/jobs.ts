/** Jobs of the service: their state until they end, their result, and cancellation. */

import type { JobDocument } from "./api.js";
import type { Client, FileOptions } from "./client.js";
import { Problem } from "./problem.js";

/** Longest wait for the end of a job in one poll, s. */
const POLL_S = 5;
/** Bounds of the pause between two polls, s. They limit `Retry-After`. */
const PAUSE_S = { min: 0.5, max: 30 };

/**
 * Follows the job at `address` to its end and returns the response with its result. Throws the Problem of a failed job.
 * Aborting `signal` cancels the job.
 */
export async function followJob(client: Client, address: string, { signal, onProgress, init }: FileOptions): Promise<Response> {
  const cancel = () => void client.ask(address, { method: "DELETE", keepalive: true }).catch(() => undefined);
  // The signal may have been aborted while the response arrived.
  if (signal?.aborted) cancel();
  signal?.addEventListener("abort", cancel, { once: true });
  const options: RequestInit = { cache: "no-store", ...init, ...(signal && { signal }) };
  try {
    const { problem } = await ended(client, address, options, onProgress);
    if (problem) throw new Problem(problem);
  } finally {
    signal?.removeEventListener("abort", cancel);
  }
  return client.ask(`${address}/result`, options);
}

/** Resolves when a job has ended. Follows its events; polls if their stream breaks or is unavailable. */
async function ended(client: Client, address: string, options: RequestInit, onProgress: FileOptions["onProgress"]): Promise<JobDocument> {
  for (;;) {
    const last = await endedInEvents(client, address, options, onProgress);
    if (last) return last;
    const reply = await client.ask(`${address}?wait=${POLL_S}`, options);
    const job = (await reply.json()) as JobDocument;
    onProgress?.(job);
    if (isOver(job)) return job;
    const pause = Math.min(PAUSE_S.max, Math.max(PAUSE_S.min, Number(reply.headers.get("retry-after")) || 0));
    await sleep(1000 * pause, options.signal);
  }
}

/** Waits for some milliseconds. Rejects as soon as `signal` is aborted. */
export function sleep(ms: number, signal?: AbortSignal | null): Promise<void> {
  return new Promise((resolve, reject) => {
    const abort = () => {
      clearTimeout(timer);
      reject(signal?.reason as Error);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", abort);
      resolve();
    }, ms);
    if (signal?.aborted) abort();
    else signal?.addEventListener("abort", abort, { once: true });
  });
}

/**
 * Reads a job's events to its end; null if they stop before. `EventSource` sends no API key, so the response is
 * read as text.
 */
async function endedInEvents(client: Client, address: string, options: RequestInit, onProgress: FileOptions["onProgress"]): Promise<JobDocument | null> {
  try {
    const reply = await client.ask(`${address}/events`, { ...options, headers: { accept: "text/event-stream" } });
    if (!reply.body) return null;
    for await (const data of events(reply.body)) {
      const job = JSON.parse(data) as JobDocument;
      onProgress?.(job);
      if (isOver(job)) return job;
    }
  } catch {
    // The next poll reports lasting failures, and those of `onProgress`. An abort ends here.
    options.signal?.throwIfAborted();
  }
  return null;
}

const isOver = ({ status }: JobDocument) => ["successful", "failed", "dismissed"].includes(status);

/** Yields the data of server-sent events. Each event is the whole state of a job, so a broken stream is not resumed. */
async function* events(body: ReadableStream<Uint8Array>): AsyncGenerator<string> {
  const reader = body.pipeThrough(new TextDecoderStream() as ReadableWritablePair<string, Uint8Array>).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
      const fields = text.slice(0, end).split("\n").map((line) => /^data: ?(.*)$/.exec(line)?.[1]);
      text = text.slice(end + 2);
      const data = fields.filter((field) => field !== undefined).join("\n");
      if (data) yield data;
    }
  }
}
