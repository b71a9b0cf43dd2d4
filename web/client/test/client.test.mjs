// Tests of the package @molmesh/client, run by tests/http/openapi_clients.rs with a service at MOLMESH_URL whose archive
// has the samples. A server in this file makes the responses that a service gives under load only.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { test } from "node:test";
import { Client, Problem } from "@molmesh/client";

const client = new Client(process.env.MOLMESH_URL);
const file = readFileSync(new URL("../../../samples/1crn.cif", import.meta.url));
const magic = async (mesh) => Buffer.from(await mesh.arrayBuffer()).toString("latin1", 0, 4);
const isProblem = (...names) => (error) => error instanceof Problem && error.is(...names);

test("meshes uploads, stored structures and archive entries", async () => {
  const structure = await client.upload(file);
  const sources = { file, array: new Uint8Array(file), blob: new Blob([file]), structure, entry: { pdb: "1crn" } };
  const triangles = new Set();
  for (const [name, source] of Object.entries(sources)) {
    const mesh = await client.mesh(source, { resolution: 1, surface: "ses", color: "chain" });
    triangles.add(mesh.headers.get("molmesh-triangles"));
    assert.equal(await magic(mesh), "glTF", name);
    assert.equal((await client.reportOf(mesh)).triangles, Number([...triangles][0]));
  }
  assert.equal(triangles.size, 1);
  const ply = await client.mesh({ pdb: "1crn" }, { resolution: 1, format: "ply" });
  assert.equal(await magic(ply), "ply\n");
});

test("returns reports, estimates, pictures, areas and atoms", async () => {
  const entry = { pdb: "1crn" };
  const reports = await Promise.all([file, entry].map((source) => client.report(source, { resolution: 1 })));
  assert.deepEqual(reports.map(({ closed, atoms }) => [closed, atoms]), [[true, 327], [true, 327]]);
  const estimates = await Promise.all([file, entry].map((source) => client.estimate(source, { resolution: 1 })));
  assert.deepEqual(estimates.map(({ accepted, atoms }) => [accepted, atoms]), [[true, 327], [true, 327]]);
  assert.equal(estimates[0].grid_points, estimates[1].grid_points);
  const picture = await client.picture(entry, { width: 64, height: 48 });
  assert.equal(picture.type, "image/png");
  assert.deepEqual([...new Uint8Array(await picture.arrayBuffer()).subarray(16, 24)], [0, 0, 0, 64, 0, 0, 0, 48]);
  const areas = await Promise.all([file, entry].map((source) => client.areas(source, { surface: "sas", by: "chain" })));
  assert.equal(areas[0], areas[1]);
  assert.match(areas[0], /^chain,model,atoms,area\r?\nA,1,327,\d+/);
  assert.equal((await client.atoms(file)).count, 327);
  assert.ok((await client.capabilities()).formats.length > 5);
});

test("a job has the same result, and its key names it again", async () => {
  const states = [];
  const options = { wait: 0, idempotencyKey: `test ${Math.random()}`, onProgress: (job) => states.push(job) };
  const job = await client.mesh(file, { resolution: 0.81 }, options);
  const direct = await client.mesh(file, { resolution: 0.81 });
  assert.deepEqual(Buffer.from(await job.arrayBuffer()), Buffer.from(await direct.arrayBuffer()));
  const { jobID, status } = states.at(-1);
  assert.equal(status, "successful");
  states.length = 0;
  await client.mesh(file, { resolution: 0.81 }, options);
  assert.equal(states.at(-1).jobID, jobID);
  assert.equal(await magic(await client.follow(jobID)), "glTF");
  assert.equal((await client.job(jobID, { wait: 1 })).status, "successful");
  await assert.rejects(client.cancel(jobID), isProblem("job-ended"));
  await assert.rejects(client.mesh(file, { resolution: 0.82 }, options), isProblem("other-request"));
});

test("errors are problems", async () => {
  const failure = await client.mesh(file, { resolution: 0.001 }).catch((error) => error);
  assert.ok(failure instanceof Problem && failure.is("bad-parameter"));
  assert.deepEqual([failure.document.status, failure.document.parameter], [400, "resolution"]);
  await assert.rejects(client.mesh(new Blob(["nothing"]), {}, { wait: 0 }), isProblem("unreadable-structure"));
  await assert.rejects(client.report({ digest: "0".repeat(64) }), isProblem("no-such-structure"));
  await assert.rejects(client.reportOf(new Response("")), /no report/);
});

test("an aborted call cancels its job", async () => {
  const abort = new AbortController();
  let id;
  const mesh = client.mesh({ pdb: "4pti" }, { resolution: 0.06, surface: "ses" }, {
    wait: 0,
    signal: abort.signal,
    onProgress: (job) => ((id = job.jobID), abort.abort()),
  });
  await assert.rejects(mesh, { name: "AbortError" });
  assert.equal((await client.job(id, { wait: 20 })).status, "dismissed");
  await assert.rejects(client.follow(id), isProblem("job-dismissed"));
});

/** Calls `use` with a client of a server that responds to the n-th request with `replies[n]`, and with the requests. */
async function withServer(replies, options, use) {
  const requests = [];
  const server = createServer((request, reply) => {
    const [status, headers, body] = replies[requests.length] ?? [500, {}, "unexpected"];
    requests.push(request);
    reply.writeHead(status, { "content-type": "application/json", ...headers }).end(body);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const started = performance.now();
  try {
    await use(new Client(`http://127.0.0.1:${server.address().port}`, options), requests, () => performance.now() - started);
  } finally {
    server.closeAllConnections();
    server.close();
  }
}

const busy = (seconds) => [503, { "retry-after": String(seconds) }, JSON.stringify({ type: "/problems/queue-full", title: "busy", status: 503 })];
const document = [200, {}, "{}"];

test("requests are repeated after Retry-After, within limits", async () => {
  await withServer([busy(1), busy(0), document], { key: "secret" }, async (client, requests, elapsed) => {
    await client.upload(file);
    assert.equal(requests.length, 3);
    assert.ok(elapsed() >= 990, `${elapsed()} ms`);
    assert.ok(requests.every(({ headers }) => headers.authorization === "Bearer secret" && headers["content-length"] === String(file.length)));
  });
  for (const [replies, options] of [
    [[busy(0), busy(0), document], { retries: 1 }],
    [[busy(0), busy(3600), document], {}],
    [[busy(0), [503, {}, ""], document], {}],
  ])
    await withServer(replies, options, async (client, requests) => {
      const failure = await client.capabilities().catch((error) => error);
      assert.ok(failure instanceof Problem && failure.document.status === 503, String(failure));
      assert.equal(requests.length, 2);
    });
  const abort = new AbortController();
  await withServer([busy(60)], {}, async (client, requests) => {
    setTimeout(() => abort.abort(), 50);
    await assert.rejects(client.capabilities({ signal: abort.signal }), { name: "AbortError" });
    assert.equal(requests.length, 1);
  });
});

test("the key is sent to the server of the service only", async () => {
  await withServer([document, document], {}, async ({ base }, requests) => {
    const other = new Client("http://127.0.0.1:9", { key: "secret" });
    assert.deepEqual(await other.json(`${base}/v1/capabilities`), {});
    await new Client(base, { key: "secret" }).json(`${base}/v1/capabilities`);
    assert.deepEqual(requests.map(({ headers }) => headers.authorization), [undefined, "Bearer secret"]);
  });
});

test("a job whose events break off is polled", async () => {
  const job = (status) => JSON.stringify({ jobID: "a", status, problem: null });
  const events = [200, { "content-type": "text/event-stream" }, `id: 1\nevent: running\ndata: ${job("running")}\n\n`];
  const replies = [[202, { location: "/v1/jobs/a" }, job("accepted")], events, [200, { "retry-after": "1" }, job("running")], events, [200, {}, job("successful")], [200, {}, "mesh"]];
  await withServer(replies, {}, async (client, requests, elapsed) => {
    const mesh = await client.mesh(file, {}, { priority: 6, wait: 4.2 });
    assert.equal(await mesh.text(), "mesh");
    assert.deepEqual(requests.map(({ method, url }) => `${method} ${url}`), [
      "POST /v1/meshes", "GET /v1/jobs/a/events", "GET /v1/jobs/a?wait=5", "GET /v1/jobs/a/events", "GET /v1/jobs/a?wait=5", "GET /v1/jobs/a/result",
    ]);
    assert.deepEqual([requests[0].headers.prefer, requests[0].headers.priority], ["wait=5", "u=6"]);
    assert.ok(elapsed() >= 990, `${elapsed()} ms`);
  });
});

test("the package has the version of the service", async () => {
  const { version } = JSON.parse(readFileSync(new URL("../package.json", import.meta.url), "utf8"));
  assert.equal((await client.capabilities()).version, version);
});
