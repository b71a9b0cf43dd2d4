// Meshes a file and follows a job with a client that @hey-api/openapi-ts generated, for tests/http/openapi_clients.rs.
// Usage: URL FILE. The generated code parses types that it does not know, such as model/gltf-binary, as JSON: hence
// `Accept`.
import { readFileSync } from "node:fs";
import { createMesh, createReport, showJob, showResult } from "./client";
import { client } from "./client/client.gen";

async function main(baseUrl: string, path: string): Promise<void> {
  client.setConfig({ baseUrl, headers: { Accept: "application/octet-stream, */*;q=0.5" } });
  const body = new Blob([readFileSync(path)]);

  const mesh = await createMesh({ body, throwOnError: true });
  if (!(mesh.data instanceof Blob)) throw new Error("not a file");
  if ((await mesh.data.slice(0, 4).text()) !== "glTF") throw new Error(await mesh.data.text());

  const headers = { Prefer: "respond-async" };
  const accepted = await createMesh({ body, query: { resolution: 0.7 }, headers, throwOnError: true });
  if (accepted.data instanceof Blob) throw new Error("not a job");
  let job = accepted.data;
  while (job.status !== "successful" && job.status !== "failed") {
    job = (await showJob({ path: { id: job.jobID }, query: { wait: 20 }, throwOnError: true })).data;
  }
  if (!job.result) throw new Error(JSON.stringify(job));
  const result = await showResult({ path: { file: job.result }, throwOnError: true });
  if (result.data.size >= mesh.data.size) throw new Error(`${result.data.size} bytes`);

  const report = await createReport({ body, throwOnError: true });
  if (!report.data.closed || report.data.atoms !== 327) throw new Error(JSON.stringify(report.data));

  const { error } = await createMesh({ body, query: { resolution: 0.001 } });
  if (error?.status !== 400 || error.parameter !== "resolution") throw new Error(JSON.stringify(error));
}

void main(process.argv[2], process.argv[3]);
