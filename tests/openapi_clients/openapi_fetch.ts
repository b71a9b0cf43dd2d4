// Meshes a file and follows a job with openapi-fetch and the types of openapi-typescript, for
// tests/http/openapi_clients.rs. Usage: URL FILE. openapi-fetch sends and parses JSON unless it is told otherwise:
// hence the options of the client and `parseAs`. openapi-typescript takes every file for text: hence `as never`.
import { readFileSync } from "node:fs";
import createClient from "openapi-fetch";
import type { paths } from "./client";

async function main(baseUrl: string, path: string): Promise<void> {
  const client = createClient<paths>({ baseUrl, bodySerializer: (body) => body, headers: { "Content-Type": "application/octet-stream" } });
  const body = new Blob([readFileSync(path)]) as never;

  const mesh = await client.POST("/v1/meshes", { body, parseAs: "blob" });
  const glb: unknown = mesh.data;
  if (!(glb instanceof Blob) || (await glb.slice(0, 4).text()) !== "glTF") throw new Error(JSON.stringify(mesh.error));

  const params = { query: { resolution: 0.7 }, header: { Prefer: "respond-async" } };
  const accepted = await client.POST("/v1/meshes", { body, params });
  if (accepted.response.status !== 202) throw new Error(JSON.stringify(accepted.error));
  const { jobID } = accepted.data as { jobID: string };
  for (;;) {
    const { data: job } = await client.GET("/v1/jobs/{id}", { params: { path: { id: jobID }, query: { wait: 20 } } });
    if (job?.status === "accepted" || job?.status === "running") continue;
    if (!job?.result) throw new Error(JSON.stringify(job));
    const result = await client.GET("/v1/results/{file}", { params: { path: { file: job.result } }, parseAs: "arrayBuffer" });
    const bytes: unknown = result.data;
    if (!(bytes instanceof ArrayBuffer) || bytes.byteLength >= glb.size) throw new Error(String(bytes));
    break;
  }

  const { data: report } = await client.POST("/v1/report", { body });
  if (!report?.closed || report.atoms !== 327) throw new Error(JSON.stringify(report));

  const { error } = await client.POST("/v1/meshes", { body, params: { query: { resolution: 0.001 } } });
  if (error?.status !== 400 || error.parameter !== "resolution") throw new Error(JSON.stringify(error));
}

void main(process.argv[2], process.argv[3]);
