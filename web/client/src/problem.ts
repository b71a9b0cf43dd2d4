/** Problem documents of the service (RFC 9457) as errors. */

import type { Problem as Document } from "./api.js";

/** Last segment of the type of a problem, such as `bad-parameter`. */
export type ProblemName = Document["type"] extends `/problems/${infer Name}` ? Name : never;

/** Problem document. Problems that do not come from the service have types of their own. */
export interface ProblemDocument {
  type: string;
  title: string;
  status: number;
  detail?: string;
  instance?: string;
  parameter?: string;
  suggested_resolution?: number;
  [member: string]: unknown;
}

/** Response of the service that is not a success. */
export class Problem extends Error {
  /** `retryAfter` is the time after which the same request may succeed, s; null if the service states none. */
  constructor(readonly document: ProblemDocument, readonly retryAfter: number | null = null) {
    super(document.detail ?? document.title);
    this.name = "Problem";
  }

  /** Returns true if the problem has one of these types. */
  is(...names: ProblemName[]): boolean {
    return names.some((name) => this.document.type.endsWith(`/${name}`));
  }
}

/** Returns the problem in a response, or one made from its status if it contains none, as from a proxy. */
export async function problemOf(reply: Response): Promise<Problem> {
  const fallback: ProblemDocument = {
    type: "/problems/unknown",
    title: `The server answered ${reply.status}`,
    status: reply.status,
    detail: reply.statusText,
  };
  const seconds = Number.parseFloat(reply.headers.get("retry-after") ?? "");
  const isJson = (reply.headers.get("content-type") ?? "").includes("json");
  const document = isJson ? ((await reply.json().catch(() => fallback)) as ProblemDocument) : fallback;
  return new Problem({ ...fallback, ...document }, Number.isNaN(seconds) ? null : seconds);
}
