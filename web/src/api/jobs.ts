/** Files that may take long: whoever is promised a job instead of the file follows its events, and cancels it on leaving. */

import type { Client } from "./client";
import { Problem, type ProblemDocument } from "./problem";

export interface Job {
  jobID: string;
  status: "accepted" | "running" | "successful" | "failed" | "dismissed";
  fraction: number;
  stage: string | null;
  problem: ProblemDocument | null;
}

/** Called with how far a promised job is. */
export type Progress = (job: Job) => void;

/**
 * The file at `path`. If a job is promised instead (202), its events are followed and its result is fetched. When `signal`
 * is aborted, the request is cancelled, and so is the job.
 */
export async function fetchFile(client: Client, path: string, signal: AbortSignal, progress: Progress, headers: HeadersInit = {}): Promise<Response> {
  // Meshes are large and made in milliseconds: not worth the browser's disk.
  const reply = await client.ask(path, { signal, headers, cache: "no-store" });
  if (reply.status !== 202) return reply;
  const job = (await reply.json()) as Job;
  const dismiss = () => void client.ask(`/v1/jobs/${job.jobID}`, { method: "DELETE", keepalive: true }).catch(() => undefined);
  // It may have been aborted while the answer was read.
  if (signal.aborted) dismiss();
  signal.addEventListener("abort", dismiss, { once: true });
  try {
    progress(job);
    await ended(client, job, signal, progress);
  } finally {
    signal.removeEventListener("abort", dismiss);
  }
  return client.ask(`/v1/jobs/${job.jobID}/result`, { signal, cache: "no-store" });
}

/** Waits for a job's end. The browser's own EventSource sends no key, so events are read from a plain answer. */
async function ended(client: Client, job: Job, signal: AbortSignal, progress: Progress): Promise<void> {
  let last = "";
  for (;;) {
    const headers: Record<string, string> = { accept: "text/event-stream" };
    if (last) headers["last-event-id"] = last;
    const reply = await client.ask(`/v1/jobs/${job.jobID}/events`, { signal, headers, cache: "no-store" });
    if (reply.status === 204 || !reply.body) return;
    for await (const { id, data } of events(reply.body)) {
      if (id) last = id;
      if (!data) continue;
      const now = JSON.parse(data) as Job;
      progress(now);
      if (now.status === "successful") return;
      // The result says why there is none.
      if (now.status === "failed" && now.problem) throw new Problem(now.problem);
      if (now.status === "failed" || now.status === "dismissed") return;
    }
    // The stream was cut, by a proxy or a restart: it is taken up after the last event that was seen.
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
}

async function* events(body: ReadableStream<Uint8Array>): AsyncGenerator<{ id: string; data: string }> {
  const reader = body.pipeThrough(new TextDecoderStream() as ReadableWritablePair<string, Uint8Array>).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
      const fields = text.slice(0, end).split("\n").map((line) => /^(\w+): ?(.*)$/.exec(line));
      text = text.slice(end + 2);
      const field = (name: string) => fields.filter((f) => f?.[1] === name).map((f) => f?.[2]).join("\n");
      yield { id: field("id"), data: field("data") };
    }
  }
}
