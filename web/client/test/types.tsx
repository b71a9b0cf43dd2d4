// Types of the package @molmesh/client, compiled by tests/http/openapi_clients.rs. Lines with an expected error fail if
// they have none.
import { Client, Problem, type JobDocument, type MeshParameters, type ReportDocument } from "@molmesh/client";
import { MolmeshViewer } from "@molmesh/client/viewer";

export async function calls(client: Client, file: File, signal: AbortSignal): Promise<void> {
  const parameters: MeshParameters = { surface: "ses", probe: 1.4, color: "chain", atom_ids: true, format: "glb" };
  const mesh: Response = await client.mesh(file, parameters, { signal, wait: 0, idempotencyKey: "1", onProgress: (job: JobDocument) => job.fraction });
  const report: ReportDocument = await client.report({ pdb: "1crn" }, parameters);
  const volume: number | null | undefined = report.volume;
  const picture: Blob = await client.picture({ digest: "0" }, { width: 100, view: "front" });
  const areas: string = await client.areas(file, { surface: "sas", by: "atom" });
  await client.mesh(await client.upload(file));
  if (volume && (await client.job("0", { wait: 20 })).status === "successful") console.log(mesh, picture, areas);
  // @ts-expect-error: no such surface
  await client.mesh(file, { surface: "sea" });
  // @ts-expect-error: no such parameter
  await client.mesh(file, { resolutoin: 1 });
  // @ts-expect-error: the surface is missing
  await client.areas(file, { by: "atom" });
  // @ts-expect-error: the format of a picture is fixed
  await client.picture(file, { format: "glb" });
  // @ts-expect-error: not a structure
  await client.mesh({ id: "1crn" });
}

export function explain(error: unknown): string {
  if (!(error instanceof Problem)) return String(error);
  // @ts-expect-error: no such type
  if (error.is("grid-to-large")) return "";
  return error.is("grid-too-large") ? `try ${error.document.suggested_resolution} Å` : error.message;
}

export function listen(): void {
  const viewer: MolmeshViewer = document.createElement("molmesh-viewer");
  document.querySelector("molmesh-viewer")?.addEventListener("molmesh-pick", ({ detail }) => detail.atom ?? detail.point?.[0]);
  viewer.addEventListener("molmesh-error", ({ detail }) => detail.problem?.status);
  viewer.addEventListener("click", (event) => event.preventDefault());
  // @ts-expect-error: a load has no atom
  viewer.addEventListener("molmesh-load", ({ detail }) => detail.atom);
}

export const element = <molmesh-viewer src="surface.glb" scheme="chain" sticks transparency={60} style={{ height: "60vh" }} onClick={listen}>no surface</molmesh-viewer>;
// @ts-expect-error: no such attribute
export const wrong = <molmesh-viewer source="surface.glb" />;
// @ts-expect-error: not a number or text
export const invalid = <molmesh-viewer transparency />;
