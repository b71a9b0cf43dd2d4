/** Problem documents of the service (RFC 9457) as errors. */

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

  /** Returns true if the last segment of the type is one of `slugs`. */
  is(...slugs: string[]): boolean {
    return slugs.some((slug) => this.document.type.endsWith(`/${slug}`));
  }

  /** Returns the names and values of non-standard members, formatted for display. */
  get numbers(): [string, string][] {
    const standard = ["type", "title", "status", "detail", "instance", "diagnostics"];
    return Object.entries(this.document)
      .filter(([name, value]) => !standard.includes(name) && value !== null && typeof value !== "object")
      .map(([name, value]) => [name.replaceAll(/[_-]/g, " "), typeof value === "number" ? value.toLocaleString("en") : String(value)]);
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
  if (!(reply.headers.get("content-type") ?? "").includes("json")) return new Problem(fallback);
  const document = (await reply.json().catch(() => fallback)) as ProblemDocument;
  return new Problem({ ...fallback, ...document });
}

/** Returns any failure as a problem. Failures without a document are mostly connection errors. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  const offline = error instanceof TypeError;
  return new Problem({
    type: "/problems/unreachable",
    title: offline ? "The server cannot be reached" : "The surface cannot be shown",
    status: 0,
    detail: offline ? "The connection failed. Check that the service is running and the network is available." : String((error as Error).message ?? error),
  });
}
