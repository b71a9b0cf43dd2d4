/** Client of the service: structures, meshes, pictures, reports, areas and jobs. */

import type {
  AreaParameters,
  AtomParameters,
  AtomsDocument,
  Capabilities,
  EstimateDocument,
  JobDocument,
  MeshParameters,
  Report,
  ReportDocument,
  StructureDocument,
} from "./api.js";
import { followJob, sleep } from "./jobs.js";
import { problemOf } from "./problem.js";

/** Bytes of a structure file. */
export type StructureBytes = Blob | ArrayBuffer | Uint8Array;
/** A structure file, a structure that was uploaded before, or an entry of the archive. */
export type Structure = StructureBytes | { digest: string } | { pdb: string };

export interface ClientOptions {
  /** API key. */
  key?: string;
  /** Number of times that a request is repeated after `Retry-After`. Default: 3. */
  retries?: number;
}

export interface RequestOptions {
  /** Cancels the request and its job. */
  signal?: AbortSignal | undefined;
}

export interface FileOptions extends RequestOptions {
  /** Called with the state of the job, if the service makes the file in a job. */
  onProgress?: ((job: JobDocument) => void) | undefined;
  /** Further options of each request. */
  init?: RequestInit | undefined;
}

export interface MeshOptions extends FileOptions {
  /** Time after which the service makes the file in a job, s; 0: at once. Default: 5. */
  wait?: number;
  /** Repeated calls with the same key get the same job. */
  idempotencyKey?: string;
  /** Urgency among the requests of this client, from 0 (first) to 7 (last). Default: 3. */
  priority?: number;
}

/** Time after which the service responds with a job, s. */
const WAIT_S = 5;
/** Longest `Retry-After` that is waited for, s. */
const RETRY_S = 120;
/** Statuses after which the same request may succeed. */
const REPEATED = [424, 429, 503];

export class Client {
  /** API key, held in memory only; empty: none. */
  key: string;
  private readonly base: string | URL;
  private readonly retries: number;

  /** `base` is the address of the service, such as `http://127.0.0.1:8080`. A path in it is ignored. */
  constructor(base: string | URL, { key = "", retries = 3 }: ClientOptions = {}) {
    this.base = base;
    this.key = key;
    this.retries = retries;
  }

  /** Meshes a structure. Follows a job to its end; aborting `signal` cancels it. */
  async mesh(structure: Structure, parameters: MeshParameters = {}, options: MeshOptions = {}): Promise<Response> {
    const { format, ...others } = parameters;
    const path = pathOf(structure);
    const [address, body] = path
      ? [`${path}/surface.${format ?? "glb"}${query(others)}`, {}]
      : [`/v1/meshes${query(parameters)}`, upload(structure as StructureBytes)];
    return this.file(address, { ...options, init: { ...options.init, ...body } });
  }

  /** Renders a picture of a surface, in PNG. */
  async picture(structure: Structure, parameters: Omit<MeshParameters, "format"> = {}, options: MeshOptions = {}): Promise<Blob> {
    return (await this.mesh(structure, { ...parameters, format: "png" }, options)).blob();
  }

  /** Meshes a structure and returns the report without the mesh, within the deadline of the service. */
  async report(structure: Structure, parameters: MeshParameters = {}, options: RequestOptions = {}): Promise<ReportDocument> {
    const path = pathOf(structure);
    if (path) return this.json(`${path}/report.json${query(parameters)}`, options);
    return this.json(`/v1/report${query(parameters)}`, { ...options, ...upload(structure as StructureBytes) });
  }

  /** Returns the stored report of a mesh or picture that this client received. */
  async reportOf(mesh: Response, options: RequestOptions = {}): Promise<Report> {
    const address = mesh.headers.get("content-location");
    if (!address) throw new Error("the service has not stored this mesh, so there is no report of it");
    return this.json(new URL(`${address.replace(/\.[^/.]+$/, "")}/report.json`, mesh.url).href, options);
  }

  /** Estimates size and time of a mesh. */
  async estimate(structure: Structure, parameters: MeshParameters = {}, options: RequestOptions = {}): Promise<EstimateDocument> {
    if (isFile(structure)) return this.json(`/v1/estimate${query(parameters)}`, { ...options, ...upload(structure) });
    const name = "pdb" in structure ? { pdb_id: structure.pdb } : { structure: structure.digest };
    const init = { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ ...parameters, ...name }) };
    return this.json("/v1/estimate", { ...options, ...init });
  }

  /** Uploads a structure. The result names it in other calls. */
  async upload(file: StructureBytes, options: RequestOptions = {}): Promise<StructureDocument> {
    return this.json("/v1/structures", { ...options, ...upload(file) });
  }

  /**
   * Returns the exact areas of a structure as CSV, by residue, atom or chain. An apostrophe precedes names that a
   * spreadsheet would execute.
   */
  async areas(structure: Structure, parameters: AreaParameters, options: RequestOptions = {}): Promise<string> {
    const path = pathOf(structure);
    const [address, body] = path
      ? [`${path}/areas${query(parameters)}`, {}]
      : [`/v1/areas${query(parameters)}`, upload(structure as StructureBytes)];
    return (await this.ask(address, { ...options, ...body })).text();
  }

  /** Returns the names of the atoms of a structure. Uploads a file first. */
  async atoms(structure: Structure, parameters: AtomParameters = {}, options: RequestOptions = {}): Promise<AtomsDocument> {
    const path = pathOf(structure) ?? `/v1/structures/${(await this.upload(structure as StructureBytes, options)).digest}`;
    return this.json(`${path}/atoms${query(parameters)}`, options);
  }

  /** Returns formats, parameters, limits and devices of the service. */
  async capabilities(options: RequestOptions = {}): Promise<Capabilities> {
    return this.json("/v1/capabilities", options);
  }

  /** Returns the state of a job. With `wait`, at most 55 s, responds when the job has ended or the time has passed. */
  async job(id: string, { wait, ...options }: RequestOptions & { wait?: number } = {}): Promise<JobDocument> {
    return this.json(`/v1/jobs/${encodeURIComponent(id)}${query({ wait })}`, options);
  }

  /** Follows a job to its end and returns its result. Aborting `signal` cancels the job. */
  async follow(id: string, options: FileOptions = {}): Promise<Response> {
    return followJob(this, this.address(`/v1/jobs/${encodeURIComponent(id)}`).href, options);
  }

  /** Cancels a job. */
  async cancel(id: string, options: RequestOptions = {}): Promise<JobDocument> {
    return this.json(`/v1/jobs/${encodeURIComponent(id)}`, { ...options, method: "DELETE" });
  }

  /** Fetches the file at a path of the service or at a full URL, through a job if the service makes it in one. */
  async file(path: string, options: MeshOptions = {}): Promise<Response> {
    const { wait = WAIT_S, idempotencyKey, priority, signal, init } = options;
    const headers = new Headers(init?.headers);
    if (this.acceptsPreference(path)) headers.set("prefer", wait > 0 ? `wait=${Math.ceil(wait)}` : "respond-async");
    if (idempotencyKey !== undefined) headers.set("idempotency-key", idempotencyKey);
    if (priority !== undefined) headers.set("priority", `u=${priority}`);
    let reply = await this.ask(path, { ...init, headers, ...(signal && { signal }) });
    if (reply.status === 202) {
      const location = reply.headers.get("location");
      if (!location) throw new Error("the server accepted a job but sent no Location header for it");
      const { method, body, ...others } = init ?? {};
      reply = await followJob(this, new URL(location, reply.url).href, { ...options, init: others });
    }
    if (reply.status !== 200) throw new Error(`the server answered ${reply.status} ${reply.statusText} instead of a file`);
    return reply;
  }

  /**
   * Sends a request to a path of the service or to a full URL. Repeats it after `Retry-After` if it may succeed then.
   * Throws a Problem unless the status is a success.
   */
  async ask(path: string, options: RequestInit = {}): Promise<Response> {
    const address = this.address(path);
    const headers = new Headers(options.headers);
    // Other servers must not get the key.
    if (this.key && this.isOwn(address)) headers.set("authorization", `Bearer ${this.key}`);
    for (let repeated = 0; ; repeated += 1) {
      const reply = await fetch(address, { ...options, headers });
      if (reply.ok) return reply;
      const problem = await problemOf(reply);
      const pause = problem.retryAfter;
      if (repeated >= this.retries || !REPEATED.includes(reply.status) || pause === null || pause > RETRY_S) throw problem;
      await sleep(1000 * pause, options.signal);
    }
  }

  /** Sends a request and returns the JSON document in the response. */
  async json<T>(path: string, options: RequestInit = {}): Promise<T> {
    return (await (await this.ask(path, options)).json()) as T;
  }

  private address(path: string): URL {
    return new URL(path, this.base);
  }

  /**
   * Returns true if `Prefer` may be sent. The header makes browsers send a preflight request, which a static file
   * server of another origin rejects.
   */
  private acceptsPreference(path: string): boolean {
    const address = this.address(path);
    return this.isOwn(address) || address.pathname.includes("/v1/");
  }

  /** Returns true if `address` is on the server of the service. */
  private isOwn(address: URL): boolean {
    return address.origin === new URL(this.base).origin;
  }
}

const isFile = (structure: Structure): structure is StructureBytes =>
  structure instanceof Blob || structure instanceof ArrayBuffer || structure instanceof Uint8Array;

/** Returns the path of a structure on the server; null for a file. */
function pathOf(structure: Structure): string | null {
  if (isFile(structure)) return null;
  return "pdb" in structure ? `/v1/pdb/${encodeURIComponent(structure.pdb)}` : `/v1/structures/${encodeURIComponent(structure.digest)}`;
}

const upload = (file: StructureBytes): RequestInit => ({ method: "POST", body: file as BodyInit, headers: { "content-type": "application/octet-stream" } });

/** Returns the query with all parameters that are set. */
function query(parameters: object): string {
  const set = Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null);
  return set.length ? `?${new URLSearchParams(set.map(([name, value]) => [name, String(value)]))}` : "";
}
