/**
 * Requests for files that may take long. If a file is not ready after a few seconds, the service returns a job, which
 * is followed to its result and cancelled on abort. Used by the page and by `<molmesh-viewer>`.
 */

import type { Client } from "./client";
import { Problem, type ProblemDocument } from "./problem";

export interface Job {
  jobID: string;
  status: "accepted" | "running" | "successful" | "failed" | "dismissed";
  fraction: number;
  stage: string | null;
  problem: ProblemDocument | null;
}

/** Called with the state of a job that is being followed. */
export type Progress = (job: Job) => void;

/** Time after which the service responds with a job, s. */
const WAIT_S = 5;
/** Longest wait for the end of a job in one poll, s. */
const POLL_S = 5;
/** Bounds of the pause between two polls, s. They limit `Retry-After`. */
const PAUSE_S = { min: 0.5, max: 30 };

/** Keeps meshes out of the browser's cache: they are large and made in milliseconds. */
const UNCACHED: RequestInit = { cache: "no-store" };

/**
 * Fetches the file at `path`. Follows a job through its `Location` to the result; throws the Problem of a failed job.
 * Aborting `signal` cancels the request and the job.
 */
export async function fetchFile(
  client: Client, path: string, signal: AbortSignal, progress: Progress, options: RequestInit = UNCACHED,
): Promise<Response> {
  const headers = new Headers(options.headers);
  if (acceptsPreference(path)) headers.set("prefer", `wait=${WAIT_S}`);
  const reply = await client.ask(path, { ...options, headers, signal });
  return reply.status === 202 ? follow(client, reply, signal, progress) : complete(reply);
}

/**
 * Returns true if `Prefer` may be sent. The header makes browsers send a preflight request, which a static file server
 * of another origin rejects.
 */
function acceptsPreference(path: string): boolean {
  const { origin, pathname } = new URL(path, location.href);
  return origin === location.origin || pathname.includes("/v1/");
}

/** Follows the job that `reply` announces. */
async function follow(client: Client, reply: Response, signal: AbortSignal, progress: Progress): Promise<Response> {
  const location = reply.headers.get("location");
  if (!location) throw new Error("the server accepted a job but sent no Location header for it");
  const address = new URL(location, reply.url).href;
  const cancel = () => void client.ask(address, { method: "DELETE", keepalive: true }).catch(() => undefined);
  // The signal may have been aborted while the response arrived.
  if (signal.aborted) cancel();
  signal.addEventListener("abort", cancel, { once: true });
  try {
    const { problem } = await ended(client, address, signal, progress);
    if (problem) throw new Problem(problem);
  } finally {
    signal.removeEventListener("abort", cancel);
  }
  return complete(await client.ask(`${address}/result`, { ...UNCACHED, signal }));
}

/** Throws on a success without a file, such as a 204. */
function complete(reply: Response): Response {
  if (reply.status !== 200) throw new Error(`the server answered ${reply.status} ${reply.statusText} instead of a file`);
  return reply;
}

/** Resolves when a job has ended. Follows its events; polls if their stream breaks or is unavailable. */
async function ended(client: Client, address: string, signal: AbortSignal, progress: Progress): Promise<Job> {
  for (;;) {
    const last = await endedInEvents(client, address, signal, progress);
    if (last) return last;
    const reply = await client.ask(`${address}?wait=${POLL_S}`, { ...UNCACHED, signal });
    const job = (await reply.json()) as Job;
    progress(job);
    if (isOver(job)) return job;
    const pause = Math.min(PAUSE_S.max, Math.max(PAUSE_S.min, Number(reply.headers.get("retry-after")) || 0));
    await sleep(1000 * pause, signal);
  }
}

/** Waits for some milliseconds. Rejects as soon as `signal` is aborted. */
function sleep(ms: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const abort = () => {
      clearTimeout(timer);
      reject(signal.reason as Error);
    };
    const timer = setTimeout(() => {
      signal.removeEventListener("abort", abort);
      resolve();
    }, ms);
    if (signal.aborted) abort();
    else signal.addEventListener("abort", abort, { once: true });
  });
}

/**
 * Reads a job's events to its end; null if they stop before. `EventSource` sends no API key, so the response is
 * read as text.
 */
async function endedInEvents(
  client: Client, address: string, signal: AbortSignal, progress: Progress,
): Promise<Job | null> {
  try {
    const headers = { accept: "text/event-stream" };
    const reply = await client.ask(`${address}/events`, { ...UNCACHED, signal, headers });
    if (!reply.body) return null;
    for await (const data of events(reply.body)) {
      const job = JSON.parse(data) as Job;
      progress(job);
      if (isOver(job)) return job;
    }
  } catch {
    // The next poll reports lasting failures. An abort ends here.
    signal.throwIfAborted();
  }
  return null;
}

const isOver = ({ status }: Job) => ["successful", "failed", "dismissed"].includes(status);

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
