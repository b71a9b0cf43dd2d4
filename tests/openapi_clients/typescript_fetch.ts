// Meshes a file and follows a job with a client that openapi-generator made for TypeScript (typescript-fetch), for
// tests/http/openapi_clients.rs. Usage: URL FILE.
import { readFileSync } from "node:fs";
import { Configuration, JobStatus, JobsApi, MeshesApi, ResponseError, ResultsApi } from "./client";

async function main(url: string, path: string): Promise<void> {
  const configuration = new Configuration({ basePath: url });
  const [meshes, jobs] = [new MeshesApi(configuration), new JobsApi(configuration)];
  const results = new ResultsApi(configuration);
  const body = new Blob([readFileSync(path)]);
  const magic = async (mesh: Blob): Promise<string> => mesh.slice(0, 4).text();

  const glb = await meshes.createMesh({ body });
  if ((await magic(glb)) !== "glTF") throw new Error(`not a GLB: ${await glb.text()}`);

  const accepted = await meshes.createMeshRaw({ body, resolution: 0.7, prefer: "respond-async" });
  let job = JSON.parse(await accepted.raw.text());
  const id: string = job.jobID;
  while (job.status !== JobStatus.Successful && job.status !== JobStatus.Failed) {
    job = await jobs.showJob({ id, wait: 20 });
  }
  if (job.status !== JobStatus.Successful || !job.result) throw new Error(JSON.stringify(job));
  const smaller = await results.showResult({ file: job.result });
  if ((await magic(smaller)) !== "glTF" || smaller.size >= glb.size) throw new Error(`${smaller.size} bytes`);

  const report = await meshes.createReport({ body });
  if (!report.closed || report.atoms !== 327) throw new Error(JSON.stringify(report));

  const error = await meshes.createMesh({ body: new Blob(["nothing"]) }).catch((reason: unknown) => reason);
  if (!(error instanceof ResponseError) || error.response.status !== 422) throw new Error(`not a problem: ${error}`);
}

void main(process.argv[2], process.argv[3]);
