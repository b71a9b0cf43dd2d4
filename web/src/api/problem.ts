/** Refusals of the service (RFC 9457), as errors that carry their document. */

export interface ProblemDocument {
  type: string;
  title: string;
  status: number;
  detail?: string;
  instance?: string;
  suggested_resolution?: number;
  parameter?: string;
  [member: string]: unknown;
}

export class Problem extends Error {
  constructor(readonly document: ProblemDocument) {
    super(document.detail ?? document.title);
    this.name = "Problem";
  }

  /** Whether the last segment of the type is `slug`. */
  is(...slugs: string[]): boolean {
    return slugs.some((slug) => this.document.type.endsWith(`/${slug}`));
  }

  /** Members beside the standard ones: the numbers. */
  get numbers(): [string, string][] {
    const standard = ["type", "title", "status", "detail", "instance", "diagnostics"];
    return Object.entries(this.document)
      .filter(([name, value]) => !standard.includes(name) && value !== null && typeof value !== "object")
      .map(([name, value]) => [name.replaceAll(/[_-]/g, " "), typeof value === "number" ? value.toLocaleString("en") : String(value)]);
  }
}

/** The problem in an answer, or one made of its status where the answer holds none (a proxy's page). */
export async function problemOf(reply: Response): Promise<Problem> {
  const fallback: ProblemDocument = {
    type: "/problems/unknown",
    title: `The server answered ${reply.status}`,
    status: reply.status,
    detail: reply.statusText,
  };
  if (!(reply.headers.get("content-type") ?? "").includes("json")) return new Problem(fallback);
  const document = (await reply.json().catch(() => fallback)) as ProblemDocument;
  return new Problem({ ...fallback, ...document });
}

/** Any failure as a problem: what is no refusal is mostly a connection that did not come about. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  const offline = error instanceof TypeError;
  return new Problem({
    type: "/problems/unreachable",
    title: offline ? "The server cannot be reached" : "The surface cannot be shown",
    status: 0,
    detail: offline ? "The connection failed. Is the service running, and is the network there?" : String((error as Error).message ?? error),
  });
}
