// A request that fails, is refused, cancelled or late: the page goes on showing and describing the former surface.
import { readFileSync } from "node:fs";
import { assert, browser, clean, drop, fetched, open, remeshed, run, sample, settled, shown, start, still, PATIENCE, URL_OF_SERVICE } from "./lib.mjs";
import { packed } from "./meshopt.mjs";

const chromium = await browser();
// Small, as surfaces are compared by their pictures.
const viewport = { width: 900, height: 560 };
const page = await start(chromium, { viewport });
const problem = page.locator("#problem");
const entry = /\/v1\/pdb\/1crn\/surface\.glb/;
const refusal = { status: 503, contentType: "application/problem+json", body: JSON.stringify({ type: "/problems/queue-full", title: "The queue is full", status: 503, detail: "try later" }) };

/** Everything that names or describes the surface. */
const described = (p) =>
  p.evaluate(() => ({
    name: document.querySelector("#structure-name").textContent,
    words: document.querySelector("#structure-title").textContent,
    title: document.title,
    address: location.pathname + location.search,
    curl: document.querySelector("#curl").textContent,
    report: document.querySelector("#report table").textContent,
    now: document.querySelector("#now").textContent,
    set: [...document.querySelectorAll(".field.is-set")].map((field) => field.dataset.parameter),
    chains: document.querySelector("#p-chains").value,
    hint: document.querySelector("#p-chains").placeholder,
    preview: !document.querySelector("#preview").hidden,
  }));

const set = async (p, name, value) => {
  await p.locator(`#p-${name}`).fill(value);
  await p.locator(`#p-${name}`).press("Enter");
};
const fetchEntry = async (p, id) => {
  await p.locator("#pdb").fill(id);
  await p.locator("#pdb").press("Enter");
};

/** Runs `act`, which must change nothing, and compares page and surface before and after. */
async function unchanged(p, act) {
  await p.mouse.move(1, 1);
  const before = { ...(await described(p)), surfaces: await shown(p) };
  const seen = await still(p);
  await act();
  await settled(p);
  assert.deepEqual({ ...(await described(p)), surfaces: await shown(p) }, before);
  // The background is dithered; surfaces differ by more.
  const now = await still(p);
  assert.ok(now.data.every((v, i) => Math.abs(v - seen.data[i]) <= 8), "another surface is shown");
  assert.ok(await p.locator("#busy").isHidden(), "the page waits on");
}

/** Routes whose answers are held back until `release` is called; `asked` resolves with the first request. */
async function hold(p, pattern) {
  let release, ask;
  const held = new Promise((resolve) => (release = resolve));
  const asked = new Promise((resolve) => (ask = resolve));
  await p.route(pattern, async (route) => {
    ask();
    await held;
    await route.continue().catch(() => undefined);
  });
  return { asked, release: async () => { release(); await p.unroute(pattern); } };
}

await run({
  "a structure that cannot be loaded leaves the former one": async () => {
    await remeshed(page, () => set(page, "chains", "A"));
    assert.match((await described(page)).address, /chains=A/);
    await unchanged(page, async () => {
      await fetchEntry(page, "9xyz");
      await problem.locator("strong").waitFor();
      assert.match(await problem.textContent(), /^9XYZ: The archive has no such entry.*still that of 4PTI/s);
    });
    await unchanged(page, async () => {
      await drop(page, "poem.txt", Buffer.from("Whose woods these are I think I know"));
      await problem.locator("strong", { hasText: "poem.txt" }).waitFor();
      assert.match(await problem.textContent(), /The structure cannot be read.*still that of 4PTI/s);
    });
    // A refusal by the service, and a response that is not a mesh.
    for (const [answer, words] of [[refusal, /^1CRN: The queue is full/], [{ status: 200, contentType: "model/gltf-binary", body: "glTF?" }, /^1CRN: .*no GLB/]]) {
      await page.route(entry, (route) => route.fulfill(answer));
      await unchanged(page, async () => {
        await fetchEntry(page, "1crn");
        await problem.locator("strong", { hasText: "1CRN" }).waitFor();
        assert.match(await problem.textContent(), words);
      });
      await page.unroute(entry);
    }
    // Downloads are those of the surface that is shown, too.
    const [download] = await Promise.all([page.waitForEvent("download"), page.locator('#formats button[data-format="stl"]').click()]);
    assert.equal(download.suggestedFilename(), "4PTI.stl");
    await page.getByRole("button", { name: "Close" }).click();
  },

  "nothing changes before the mesh is there, and cancelling leaves it so": async () => {
    const mesh = await hold(page, entry);
    await unchanged(page, async () => {
      const before = await described(page);
      await fetchEntry(page, "1crn");
      await mesh.asked;
      await page.locator("#busy").waitFor();
      const { set: _, chains: __, ...during } = await described(page);
      assert.deepEqual({ ...during, set: before.set, chains: before.chains }, before);
      await page.locator("#cancel").click();
      await mesh.release();
    });
    const sending = await hold(page, /\/v1\/structures$/);
    await unchanged(page, async () => {
      await drop(page, "1crn.cif", readFileSync(sample("1crn.cif")));
      await sending.asked;
      await page.locator("#busy").waitFor();
      await page.locator("#cancel").click();
      await sending.release();
    });
  },

  "another structure takes over at once, without the names of the former one's parts": async () => {
    await remeshed(page, () => set(page, "isovalue", "0.6"));
    await page.locator("#parameters details.more").evaluate((node) => (node.open = true));
    await remeshed(page, () => set(page, "model", "1"));
    // The sample has no alternative locations.
    await page.route(/&altloc=A/, (route) => route.continue({ url: route.request().url().replace("&altloc=A", "") }));
    await remeshed(page, () => set(page, "altloc", "A"));
    await remeshed(page, () => fetchEntry(page, "1crn"));
    const now = await described(page);
    assert.deepEqual([now.name, now.address, now.set], ["1CRN", "/?pdb=1crn&isovalue=0.6", ["isovalue"]]);
    assert.equal(now.title, "1CRN · molmesh");
    assert.match(now.curl, /\/v1\/pdb\/1crn\/surface\.glb\?isovalue=0\.6'? -o 1crn\.glb$/);
    const { headers } = await fetched("/v1/pdb/1crn/surface.glb?isovalue=0.6");
    assert.ok(now.now.startsWith(`${Number(headers.get("molmesh-triangles")).toLocaleString("en")} triangles`), now.now);
  },

  "back and forward open what their addresses name, or say why not": async () => {
    const other = { name: "4PTI", address: "/?isovalue=0.6&model=1&chains=A&altloc=A" };
    const addressed = async () => (({ name, address }) => ({ name, address: [...new URLSearchParams(address.slice(2))].sort().join() }))(await described(page));
    const expected = { name: other.name, address: [...new URLSearchParams(other.address.slice(2))].sort().join() };
    await remeshed(page, () => page.goBack());
    assert.deepEqual(await addressed(), expected);
    assert.equal((await described(page)).chains, "A");
    await page.route(entry, (route) => route.fulfill(refusal));
    await unchanged(page, async () => {
      await page.goForward();
      await problem.locator("strong", { hasText: "1CRN" }).waitFor();
    });
    await page.unroute(entry);
    // The request of the failed structure is kept.
    await remeshed(page, () => page.getByRole("button", { name: "Try again" }).click());
    assert.deepEqual((({ name, address }) => [name, address])(await described(page)), ["1CRN", "/?pdb=1crn&isovalue=0.6"]);
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "a parameter that is refused is taken back": async () => {
    await unchanged(page, async () => {
      await set(page, "resolution", "0.05");
      await problem.locator("strong").waitFor();
      assert.match(await problem.textContent(), /^1CRN: The grid would be too large.*as they were before/s);
    });
    assert.equal(await page.locator("#p-resolution").inputValue(), "");
    await remeshed(page, () => problem.getByRole("button", { name: /^Take [\d.]+ Å$/ }).click());
    assert.match((await described(page)).address, /resolution=/);
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "a preview goes with the mesh that it announces": async () => {
    // Slow enough that sliders show previews.
    let refused = false;
    await page.route(entry, async (route) => {
      const isPreview = route.request().url().includes("resolution=");
      if (refused && !isPreview) return route.fulfill(refusal);
      await new Promise((resolve) => setTimeout(resolve, 400));
      await route.continue().catch(() => undefined);
    });
    await remeshed(page, () => set(page, "isovalue", "0.7"));
    refused = true;
    await unchanged(page, async () => {
      const drag = (types) =>
        page.evaluate((types) => {
          const slider = document.querySelector('[data-slider="isovalue"]');
          slider.value = "200";
          for (const type of types) slider.dispatchEvent(new Event(type, { bubbles: true }));
        }, types);
      await drag(["pointerdown", "input"]);
      await page.locator("#preview").waitFor();
      await drag(["pointerup", "change"]);
      await problem.locator("strong", { hasText: "1CRN" }).waitFor();
    });
    await page.unroute(entry);
    await page.getByRole("button", { name: "Close" }).click();
    await remeshed(page, () => page.locator("#reset-all").click());
  },

  "a mesh that is ready late does not replace a newer one": async () => {
    // Reading a packed mesh waits for its decoder, while a plain one is asked for and shown.
    const other = await start(chromium, {
      viewport,
      before: (p) => p.route(entry, async (route) => {
        const reply = await route.fetch();
        await route.fulfill({ response: reply, body: await packed(await reply.body()) });
      }),
    });
    const decoder = await hold(other, /\/assets\/meshopt/);
    await fetchEntry(other, "1crn");
    await decoder.asked;
    await remeshed(other, () => other.locator("#sample").click());
    await unchanged(other, () => decoder.release());
    assert.equal((await described(other)).name, "4PTI");
    clean(other);
    await other.context().close();
  },

  "a file that has the sample's name is not taken for it": async () => {
    await remeshed(page, () => drop(page, "sample.pdb", readFileSync(sample("1crn.cif"))));
    const { address, curl } = await described(page);
    assert.match(address, /structure=[0-9a-f]{64}/);
    assert.ok(!curl.includes("/sample.pdb"), curl);
    await page.reload({ timeout: PATIENCE });
    await page.waitForFunction(() => window.seen.length > 0, null, { timeout: PATIENCE });
    assert.equal((await described(page)).name, "1CRN");
  },

  "a hostile title or file name is shown as text": async () => {
    const attack = '<img src=x onerror="window.hit=1">';
    const atoms = readFileSync(sample("4pti.pdb"), "latin1").replace(/^TITLE.*\n/gm, "");
    await remeshed(page, () => drop(page, `${attack}.pdb`, Buffer.from(`TITLE     ${attack} \u001b[31m\n${atoms}`, "latin1")));
    const now = await described(page);
    assert.ok(now.words.includes(attack) && !now.words.includes("\u001b"), now.words);
    assert.equal(await page.locator("img[src=x]").count(), 0);
    assert.equal(await page.evaluate(() => window.hit), undefined);
    assert.ok(now.title.endsWith("molmesh"), now.title);
  },

  "a structure that the service forgets is sent again, once": async () => {
    const forgotten = { status: 404, contentType: "application/problem+json", body: JSON.stringify({ type: "/problems/no-such-structure", title: "There is no such structure", status: 404 }) };
    await remeshed(page, () => drop(page, "1crn.cif", readFileSync(sample("1crn.cif"))));
    const sent = () => page.asked.filter((line) => line.startsWith("POST")).length;
    const before = sent();
    let times = Infinity;
    await page.route(/\/v1\/structures\/[0-9a-f]+\/surface\.glb/, (route) => (times-- > 0 ? route.fulfill(forgotten) : route.continue()));
    await unchanged(page, async () => {
      await set(page, "isovalue", "0.9");
      await problem.locator("strong", { hasText: "1CRN: There is no such structure" }).waitFor();
    });
    assert.equal(sent(), before + 1);
    times = 1;
    await remeshed(page, () => set(page, "chains", "A"));
    assert.equal(sent(), before + 2);
    assert.deepEqual((await described(page)).set, ["chains"]);
    await page.unroute(/\/v1\/structures\/[0-9a-f]+\/surface\.glb/);
  },

  "without a former surface a refusal can be put right": async () => {
    const other = await open(chromium, { viewport, url: `${URL_OF_SERVICE}/?pdb=1crn&resolution=0.05` });
    const refused = other.locator("#problem");
    await refused.locator("strong", { hasText: "1CRN: The grid would be too large" }).waitFor();
    assert.ok(!/still|as they were/.test(await refused.textContent()));
    assert.equal(await other.locator("#structure-name").textContent(), "No surface");
    assert.equal(await other.locator("#p-resolution").inputValue(), "0.05");
    await remeshed(other, () => refused.getByRole("button", { name: /^Take [\d.]+ Å$/ }).click());
    const now = await described(other);
    assert.equal(now.name, "1CRN");
    assert.match(now.address, /^\/\?pdb=1crn&resolution=/);
    clean(other, /Failed to load resource/);
    await other.context().close();
  },

  "nothing else went wrong": async () => {
    // The browser notes what is refused by itself.
    clean(page, /Failed to load resource/);
  },
});
