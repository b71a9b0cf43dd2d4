/** Failures as problem documents, for display. */

import { Problem } from "../../client/src/problem";

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
