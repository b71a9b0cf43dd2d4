// <molmesh-viewer> on a page of another origin: files that become jobs, files that fail, and browsers without WebGL.
import http from "node:http";
import { assert, browser, deferred, fetchBytes, open, picture, run, silhouette, stablePicture, SERVICE_URL, TIMEOUT_MS } from "./lib.mjs";

const mesh = (await fetchBytes("/v1/pdb/1crn/surface.glb?resolution=1")).bytes;
const PAGE = `<!doctype html><html lang="en"><meta charset="utf-8"><title>component</title>
<script>
window.events = [];
for (const name of ["load", "error", "progress"]) document.addEventListener("molmesh-" + name, (event) => events.push({ name, ...event.detail }));
</script>
<molmesh-viewer id="viewer" style="width: 300px; height: 300px" FIRST><p id="fallback">a picture</p></molmesh-viewer>
<script type="module" src="${SERVICE_URL}/molmesh-viewer.js"></script></html>`;
const PROBLEM = { type: "/problems/grid-too-large", title: "The grid would be too large", status: 422, detail: "9 grid points, 4 are allowed" };

/** Requests by job, recorded by a service that makes every mesh a job. A job has the name of its mesh. */
const jobs = {};
const state = (job, status) => JSON.stringify({ jobID: job, status, fraction: 0.5, stage: "field", problem: status === "failed" ? PROBLEM : null });
const startedAt = performance.now();
const service = http.createServer((request, reply) => {
  const { pathname, search } = new URL(request.url, "http://x");
  const [, area, job, part] = pathname.split("/");
  if (area === "page") return reply.writeHead(200, { "content-type": "text/html; charset=utf-8" }).end(PAGE.replace("FIRST", job ? `src="/meshes/${job}"` : ""));
  if (area === "plain.glb") return reply.writeHead(200, { "content-type": "model/gltf-binary" }).end(mesh);
  if (area === "empty.glb") return reply.writeHead(204).end();
  if (area === "lost.glb") return reply.writeHead(202).end();
  if (area !== "meshes" && area !== "jobs") return reply.writeHead(area === "favicon.ico" ? 204 : 404).end();
  const requests = (jobs[job] ??= []);
  requests.push({ what: `${request.method} ${part ?? area}${search}`, prefer: request.headers.prefer, at: performance.now() - startedAt });
  const polls = requests.filter(({ what }) => what.startsWith("GET jobs?wait=")).length;
  if (area === "meshes") return reply.writeHead(202, { location: `/jobs/${job}`, "retry-after": "1", "content-type": "application/json" }).end(state(job, "accepted"));
  if (request.method === "DELETE") return reply.writeHead(200, { "content-type": "application/json" }).end(state(job, "dismissed"));
  if (part === "result") return reply.writeHead(303, { location: "/plain.glb" }).end();
  if (part === "events") {
    if (job.startsWith("polled")) return reply.writeHead(404).end();
    reply.writeHead(200, { "content-type": "text/event-stream" });
    for (const status of ["accepted", "running"]) reply.write(`id: 1\nevent: ${status}\ndata: ${state(job, status)}\n\n`);
    // The stream of a running job stays open; other streams end, with or without a final event.
    if (job.startsWith("long")) return;
    if (!job.startsWith("cut")) reply.write(`id: 2\ndata: ${state(job, job.startsWith("failed") ? "failed" : "successful")}\n\n`);
    return reply.end();
  }
  reply.writeHead(200, { "content-type": "application/json", "retry-after": "1" }).end(state(job, polls < 2 ? "running" : "successful"));
});
await new Promise((resolve) => service.listen(0, "127.0.0.1", resolve));
const origin = `http://127.0.0.1:${service.address().port}`;

const chromium = await browser();
const page = await open(chromium, { url: `${origin}/page/` });
await page.waitForFunction(() => customElements.get("molmesh-viewer"), null, { timeout: TIMEOUT_MS });
const load = (src) => page.evaluate((src) => ((window.events = []), (document.querySelector("#viewer").src = src)), src);
const eventOf = (name) => page.waitForFunction((name) => window.events.find((event) => event.name === name), name, { timeout: TIMEOUT_MS }).then((handle) => handle.jsonValue());
const fallbackVisible = (p) => p.locator("#fallback").isVisible();
const requestsOf = (job) => (jobs[job] ?? []).map(({ what }) => what);
const until = async (condition, what) => {
  const end = performance.now() + TIMEOUT_MS;
  while (!condition()) {
    assert.ok(performance.now() < end, `timed out: ${what}`);
    await new Promise((resolve) => setTimeout(resolve, 20));
  }
};

await run({
  "the component follows a job and shows its mesh": async () => {
    await load("/meshes/quick");
    assert.ok((await eventOf("load")).report.triangles > 1000);
    assert.deepEqual(requestsOf("quick"), ["GET meshes", "GET events", "GET result"]);
    assert.match(jobs.quick[0].prefer, /^wait=[1-9]/);
    assert.deepEqual(await page.evaluate(() => window.events.map(({ name, status }) => status ?? name)), ["accepted", "running", "successful", "load"]);
    const shape = silhouette(await picture(page, "#viewer"));
    assert.ok(shape.share > 0.1, JSON.stringify(shape));
    assert.equal(await fallbackVisible(page), false);
  },

  "without events a job is polled at the interval of Retry-After": async () => {
    for (const job of ["cut", "polled"]) {
      await load(`/meshes/${job}`);
      await eventOf("load");
      const polls = requestsOf(job).filter((what) => /^GET jobs\?wait=\d+$/.test(what));
      assert.equal(polls.length, 2, `${requestsOf(job)}`);
      assert.equal(requestsOf(job).filter((what) => what === "GET events").length, 2);
      const [first, second] = jobs[job].filter(({ what }) => what.startsWith("GET jobs"));
      assert.ok(second.at - first.at >= 990, `${second.at - first.at} ms`);
    }
  },

  "a failure is reported, and the fallback content is shown until a mesh arrives": async () => {
    for (const [src, expected, status] of [
      ["/meshes/failed", /\/meshes\/failed: The grid would be too large: 9 grid points/, 422],
      ["/nothing.glb", /404/, 404],
      ["/empty.glb", /204/, undefined],
      ["/lost.glb", /no Location/, undefined],
      ["/page/", /no GLB/, undefined],
    ]) {
      await load(src);
      const { message, problem } = await eventOf("error");
      assert.match(message, expected);
      assert.equal(problem?.status, status);
      assert.equal(await fallbackVisible(page), true);
      await load("/plain.glb");
      await eventOf("load");
      assert.equal(await fallbackVisible(page), false);
      assert.ok(silhouette(await picture(page, "#viewer")).share > 0.1, "the canvas is visible again");
    }
    // Without fallback content, the error message is shown.
    await page.evaluate(() => document.querySelector("#fallback").remove());
    await load("/meshes/failed");
    await eventOf("error");
    assert.match(await page.locator("#viewer p").textContent(), /The grid would be too large/);
    assert.ok(await page.locator("#viewer p").isVisible());
  },

  "a new `src` or removing the element cancels the job": async () => {
    await load("/meshes/long-a");
    await eventOf("progress");
    await load("/meshes/long-b");
    await until(() => requestsOf("long-a").includes("DELETE jobs"), "cancellation of the first job");
    await eventOf("progress");
    assert.ok(!requestsOf("long-b").includes("DELETE jobs"));
    await page.evaluate(() => ((window.events = []), (window.viewer = document.querySelector("#viewer")).remove()));
    await until(() => requestsOf("long-b").includes("DELETE jobs"), "cancellation of the second job");
    assert.deepEqual(await page.evaluate(() => window.events), [], "removing the element is not an error");
    // After it is inserted again, it loads and has each listener once.
    await page.evaluate(() => {
      window.viewer.src = "/plain.glb";
      document.body.append(window.viewer);
      window.picks = 0;
      window.viewer.addEventListener("molmesh-pick", () => (window.picks += 1));
    });
    await eventOf("load");
    await page.locator("#viewer").click();
    assert.equal(await page.evaluate(() => window.picks), 1);
  },

  "mesh, colours and legend change together": async () => {
    const viewer = page.locator("#viewer");
    const entryOf = (id, more) => `${SERVICE_URL}/v1/pdb/${id}/surface.glb?resolution=1${more}`;
    const setAttributes = (attributes) => viewer.evaluate((node, all) => Object.entries(all).forEach(([name, value]) => node.setAttribute(name, value)), attributes);
    const legend = () => page.locator("#viewer .legend").textContent();
    const menu = page.locator("#viewer select");
    // Pictures show the surface alone.
    await viewer.evaluate(({ shadowRoot }) => shadowRoot.querySelectorAll("select, .legend").forEach((node) => (node.style.opacity = "0")));
    const loaded = async (src) => {
      await load(src);
      await eventOf("load");
      return stablePicture(page, "#viewer");
    };
    const share = (a, b) => a.data.filter((value, i) => Math.abs(value - b.data[i]) > 24).length / a.data.length;
    const [plain, coloured] = [await loaded(entryOf("4pti", "")), await loaded(entryOf("4pti", "&color=residue"))];
    assert.ok(share(plain, coloured) > 0.02, `${share(plain, coloured)}`);
    await setAttributes({ scheme: "residue", menu: "" });
    const first = await loaded(entryOf("1crn", "&atom_ids=true"));
    const before = await legend();
    assert.ok(before.includes("THR"), before);
    // The mesh arrives long after its colours.
    const [requested, released] = [deferred(), deferred()];
    await page.route(/4pti\/surface/, async (route) => {
      requested.resolve();
      await released.promise;
      await route.continue();
    });
    await Promise.all([page.waitForResponse(/4pti\/colors/), load(entryOf("4pti", "&atom_ids=true"))]);
    await requested.promise;
    assert.ok(share(first, await stablePicture(page, "#viewer")) < 0.001);
    assert.equal(await legend(), before);
    released.resolve();
    await eventOf("load");
    assert.ok(share(coloured, await stablePicture(page, "#viewer")) < 0.002);
    assert.notEqual(await legend(), before);
    await page.unroute(/4pti\/surface/);
    // Colours that are refused leave the previous ones, also in the menu.
    const kept = await legend();
    await page.evaluate(() => (window.events = []));
    await menu.selectOption("entity");
    assert.match((await eventOf("error")).message, /entit/);
    assert.deepEqual([await legend(), await menu.inputValue()], [kept, "residue"]);
    assert.ok(share(coloured, await stablePicture(page, "#viewer")) < 0.002);
    // Vertices without atoms cannot be coloured.
    await setAttributes({ scheme: "residue" });
    assert.ok(share(plain, await loaded(entryOf("4pti", ""))) < 0.002);
    assert.match((await eventOf("error")).message, /atom_ids=true/);
    assert.ok((await page.locator("#viewer .legend").isHidden()) && (await menu.isHidden()));
    // A mesh that cannot be loaded leaves neither legend nor menu.
    await loaded(entryOf("1crn", "&atom_ids=true"));
    assert.equal(await legend(), before);
    await load("/nothing.glb");
    await eventOf("error");
    assert.ok((await page.locator("#viewer .legend").isHidden()) && (await menu.isHidden()));
    await viewer.evaluate((node) => ["scheme", "menu"].forEach((name) => node.removeAttribute(name)));
  },

  "a file on another origin needs no preflight": async () => {
    const other = http.createServer((request, reply) =>
      request.method === "GET" ? reply.writeHead(200, { "access-control-allow-origin": "*" }).end(mesh) : reply.writeHead(405).end());
    await new Promise((resolve) => other.listen(0, "127.0.0.1", resolve));
    await load(`http://127.0.0.1:${other.address().port}/plain.glb`);
    await eventOf("load");
    other.close();
    other.closeAllConnections();
  },

  "without WebGL the fallback content is shown": async () => {
    const flat = await browser("--disable-3d-apis");
    const other = await open(flat, { url: `${origin}/page/quick` });
    await other.waitForFunction(() => window.events.length > 0, null, { timeout: TIMEOUT_MS });
    assert.match((await other.evaluate(() => window.events))[0].message, /no WebGL 2/);
    assert.ok(await fallbackVisible(other));
    await flat.close();
  },

  "the page has no other errors": async () => {
    const errors = page.errors.filter((line) => !/Failed to load resource/.test(line));
    assert.deepEqual(errors, []);
  },
});
