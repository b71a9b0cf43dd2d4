// <molmesh-viewer> on a page elsewhere: files that become jobs, files that fail, and browsers without WebGL.
import http from "node:http";
import { assert, browser, fetched, open, picture, run, silhouette, PATIENCE, URL_OF_SERVICE } from "./lib.mjs";

const mesh = (await fetched("/v1/pdb/1crn/surface.glb?resolution=1")).bytes;
const PAGE = `<!doctype html><html lang="en"><meta charset="utf-8"><title>component</title>
<script>
window.told = [];
for (const name of ["load", "error", "progress"]) document.addEventListener("molmesh-" + name, (event) => told.push({ name, ...event.detail }));
</script>
<molmesh-viewer id="viewer" style="width: 300px; height: 300px" FIRST><p id="instead">a picture</p></molmesh-viewer>
<script type="module" src="${URL_OF_SERVICE}/molmesh-viewer.js"></script></html>`;
const PROBLEM = { type: "/problems/grid-too-large", title: "The grid would be too large", status: 422, detail: "9 samples, 4 are allowed" };

/** A service that makes every mesh a job. `jobs` is what it has been asked, by the job's name, which is that of the mesh. */
const jobs = {};
const state = (job, status) => JSON.stringify({ jobID: job, status, fraction: 0.5, stage: "field", problem: status === "failed" ? PROBLEM : null });
const begun = performance.now();
const service = http.createServer((request, reply) => {
  const { pathname, search } = new URL(request.url, "http://x");
  const [, area, job, part] = pathname.split("/");
  if (area === "page") return reply.writeHead(200, { "content-type": "text/html; charset=utf-8" }).end(PAGE.replace("FIRST", job ? `src="/meshes/${job}"` : ""));
  if (area === "plain.glb") return reply.writeHead(200, { "content-type": "model/gltf-binary" }).end(mesh);
  if (area === "empty.glb") return reply.writeHead(204).end();
  if (area === "lost.glb") return reply.writeHead(202).end();
  if (area !== "meshes" && area !== "jobs") return reply.writeHead(area === "favicon.ico" ? 204 : 404).end();
  const asked = (jobs[job] ??= []);
  asked.push({ what: `${request.method} ${part ?? area}${search}`, prefer: request.headers.prefer, at: performance.now() - begun });
  const times = asked.filter(({ what }) => what.startsWith("GET jobs?wait=")).length;
  if (area === "meshes") return reply.writeHead(202, { location: `/jobs/${job}`, "retry-after": "1", "content-type": "application/json" }).end(state(job, "accepted"));
  if (request.method === "DELETE") return reply.writeHead(200, { "content-type": "application/json" }).end(state(job, "dismissed"));
  if (part === "result") return reply.writeHead(303, { location: "/plain.glb" }).end();
  if (part === "events") {
    if (job.startsWith("polled")) return reply.writeHead(404).end();
    reply.writeHead(200, { "content-type": "text/event-stream" });
    for (const status of ["accepted", "running"]) reply.write(`id: 1\nevent: ${status}\ndata: ${state(job, status)}\n\n`);
    // The stream of a job that goes on stays open, and that of a broken one is cut.
    if (job.startsWith("long")) return;
    if (!job.startsWith("cut")) reply.write(`id: 2\ndata: ${state(job, job.startsWith("failed") ? "failed" : "successful")}\n\n`);
    return reply.end();
  }
  reply.writeHead(200, { "content-type": "application/json", "retry-after": "1" }).end(state(job, times < 2 ? "running" : "successful"));
});
await new Promise((resolve) => service.listen(0, "127.0.0.1", resolve));
const origin = `http://127.0.0.1:${service.address().port}`;

const chromium = await browser();
const page = await open(chromium, { url: `${origin}/page/` });
await page.waitForFunction(() => customElements.get("molmesh-viewer"), null, { timeout: PATIENCE });
const load = (src) => page.evaluate((src) => ((window.told = []), (document.querySelector("#viewer").src = src)), src);
const told = (name) => page.waitForFunction((name) => window.told.find((event) => event.name === name), name, { timeout: PATIENCE }).then((handle) => handle.jsonValue());
const instead = (p) => p.locator("#instead").isVisible();
const asked = (job) => (jobs[job] ?? []).map(({ what }) => what);
const until = async (condition, what) => {
  const end = performance.now() + PATIENCE;
  while (!condition()) {
    assert.ok(performance.now() < end, `timed out: ${what}`);
    await new Promise((resolve) => setTimeout(resolve, 20));
  }
};

await run({
  "a job is followed to its mesh": async () => {
    await load("/meshes/quick");
    assert.ok((await told("load")).report.triangles > 1000);
    assert.deepEqual(asked("quick"), ["GET meshes", "GET events", "GET result"]);
    assert.match(jobs.quick[0].prefer, /^wait=[1-9]/);
    assert.deepEqual(await page.evaluate(() => window.told.map(({ name, status }) => status ?? name)), ["accepted", "running", "successful", "load"]);
    const seen = silhouette(await picture(page, "#viewer"));
    assert.ok(seen.share > 0.1, JSON.stringify(seen));
    assert.equal(await instead(page), false);
  },

  "a job whose events are cut or unavailable is polled, no more often than Retry-After allows": async () => {
    for (const job of ["cut", "polled"]) {
      await load(`/meshes/${job}`);
      await told("load");
      const polls = asked(job).filter((what) => /^GET jobs\?wait=\d+$/.test(what));
      assert.equal(polls.length, 2, `${asked(job)}`);
      assert.equal(asked(job).filter((what) => what === "GET events").length, 2);
      const [first, second] = jobs[job].filter(({ what }) => what.startsWith("GET jobs"));
      assert.ok(second.at - first.at >= 990, `${second.at - first.at} ms`);
    }
  },

  "a failure is reported, and the content between the tags is shown until a mesh arrives": async () => {
    for (const [src, words, status] of [
      ["/meshes/failed", /\/meshes\/failed: The grid would be too large: 9 samples/, 422],
      ["/nothing.glb", /404/, 404],
      ["/empty.glb", /204/, undefined],
      ["/lost.glb", /no Location/, undefined],
      ["/page/", /no GLB/, undefined],
    ]) {
      await load(src);
      const { message, problem } = await told("error");
      assert.match(message, words);
      assert.equal(problem?.status, status);
      assert.equal(await instead(page), true);
      await load("/plain.glb");
      await told("load");
      assert.equal(await instead(page), false);
      assert.ok(silhouette(await picture(page, "#viewer")).share > 0.1, "the canvas is back");
    }
    // Without content between the tags, the reason is shown.
    await page.evaluate(() => document.querySelector("#instead").remove());
    await load("/meshes/failed");
    await told("error");
    assert.match(await page.locator("#viewer p").textContent(), /The grid would be too large/);
    assert.ok(await page.locator("#viewer p").isVisible());
  },

  "a job is cancelled when another file is wanted, or the element leaves": async () => {
    await load("/meshes/long-a");
    await told("progress");
    await load("/meshes/long-b");
    await until(() => asked("long-a").includes("DELETE jobs"), "the first job's end");
    await told("progress");
    assert.ok(!asked("long-b").includes("DELETE jobs"));
    await page.evaluate(() => ((window.told = []), (window.viewer = document.querySelector("#viewer")).remove()));
    await until(() => asked("long-b").includes("DELETE jobs"), "the second job's end");
    assert.deepEqual(await page.evaluate(() => window.told), [], "leaving is no error");
    // Back in the page, it loads again and listens once.
    await page.evaluate(() => {
      window.viewer.src = "/plain.glb";
      document.body.append(window.viewer);
      window.picks = 0;
      window.viewer.addEventListener("molmesh-pick", () => (window.picks += 1));
    });
    await told("load");
    await page.locator("#viewer").click();
    assert.equal(await page.evaluate(() => window.picks), 1);
  },

  "a file on another origin needs no preflight": async () => {
    const other = http.createServer((request, reply) =>
      request.method === "GET" ? reply.writeHead(200, { "access-control-allow-origin": "*" }).end(mesh) : reply.writeHead(405).end());
    await new Promise((resolve) => other.listen(0, "127.0.0.1", resolve));
    await load(`http://127.0.0.1:${other.address().port}/plain.glb`);
    await told("load");
    other.close();
    other.closeAllConnections();
  },

  "without WebGL the content between the tags is shown": async () => {
    const flat = await browser("--disable-3d-apis");
    const other = await open(flat, { url: `${origin}/page/quick` });
    await other.waitForFunction(() => window.told.length > 0, null, { timeout: PATIENCE });
    assert.match((await other.evaluate(() => window.told))[0].message, /no WebGL 2/);
    assert.ok(await instead(other));
    await flat.close();
  },

  "nothing else went wrong": async () => {
    const wrong = page.wrong.filter((line) => !/Failed to load resource/.test(line));
    assert.deepEqual(wrong, []);
  },
});
