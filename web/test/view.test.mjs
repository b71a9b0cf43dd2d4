// Tests of the page's state and of its requests, without a browser. `tests/cli/browser.rs` runs them.
import assert from "node:assert/strict";
import { test } from "node:test";
import { fileURLToPath } from "node:url";
import { runnerImport } from "vite";

const module = async (name) => (await runnerImport(fileURLToPath(new URL(`../src/${name}.ts`, import.meta.url)))).module;
const { EMPTY, PLAIN, current, reduce } = await module("view");
const { Rules } = await module("rules");
const { Slot } = await module("queue");

const parameter = (name, more = {}) => ({ name, format: "", insteadOf: [], ...more });
const spacings = ["resolution", "detail"];
const rules = new Rules(
  [
    ...spacings.map((name) => parameter(name, { insteadOf: spacings.filter((other) => other !== name) })),
    ...["isovalue", "smoothness", "paper_a", "paper_b", "paper_c", "compress", "color", "palette", "color_range", "color_blend"].map((name) => parameter(name)),
    ...["chains", "split", "instances"].map((name) => parameter(name)),
    parameter("width", { format: "png" }),
  ],
  { all: [], palettes: [], ofAtoms: new Set(["element", "bfactor"]) },
);
const source = (name) => ({ path: `/v1/pdb/${name}`, name: name.toUpperCase(), file: "" });
const upload = { path: "", name: "file.pdb", file: "", find: () => undefined };
const act = (state, ...actions) => actions.reduce((now, action) => reduce(now, action, rules), state);
const set = (name, value, base) => ({ type: "set", name, value, base });
const show = (state, from = state.wanted.source) => act(state, { type: "shown", request: state.wanted, source: from });
const failure = (state) => ({ type: "failed", failure: { problem: {}, view: state.wanted } });
const values = (view) => Object.fromEntries(view.choices);
const shown = show(act(EMPTY, { type: "open", source: source("1crn") }, set("isovalue", "2")));

test("a value is wanted until its view is shown", () => {
  const asked = act(shown, set("color", "element"));
  assert.deepEqual(values(asked.shown), { isovalue: "2" });
  assert.deepEqual(values(current(asked)), { isovalue: "2", color: "element" });
  const now = show(asked);
  assert.deepEqual([values(now.shown), now.wanted], [{ isovalue: "2", color: "element" }, null]);
});

test("a refused or cancelled view leaves the one shown", () => {
  const asked = act(shown, set("color", "pocket"), { type: "sticks", on: true });
  for (const end of [failure(asked), { type: "cancelled" }]) {
    const after = act(asked, end);
    assert.equal(after.shown, shown.shown);
    assert.equal(current(after), shown.shown);
  }
});

test("a failure ends with the next request, the next view and the button, and not by itself", () => {
  const asked = act(shown, set("color", "pocket"));
  const failed = act(asked, failure(asked));
  assert.ok(act(failed, { type: "adjust", display: { camera: "1,2,3" } }).failure);
  assert.equal(act(failed, set("isovalue", "3")).failure, null);
  assert.equal(act(failed, { type: "retry", view: asked.wanted }).wanted, asked.wanted);
  assert.equal(act(failed, { type: "dismiss" }).failure, null);
  // A remedy changes the refused view.
  assert.deepEqual(values(act(failed, set("isovalue", undefined, asked.wanted)).wanted), { color: "pocket" });
  // An error beside the view, such as that of a download, cancels nothing.
  const warned = act(asked, { type: "failed", failure: { problem: {}, view: null } });
  assert.equal(warned.wanted, asked.wanted);
  assert.equal(show(warned).failure, null);
});

test("without a surface to return to, a refused view can be corrected", () => {
  const asked = act(EMPTY, { type: "open", source: source("1crn"), choices: new Map([["resolution", "0.01"]]), display: PLAIN });
  const failed = act(asked, failure(asked));
  assert.deepEqual([failed.shown, values(current(failed))], [null, { resolution: "0.01" }]);
  assert.deepEqual(values(act(failed, set("detail", "2")).wanted), { detail: "2" });
});

test("another structure keeps the values that do not select atoms by names of the previous one", () => {
  const before = show(act(shown, set("chains", "A"), { type: "sticks", on: true }));
  const hidden = act(before, { type: "adjust", display: { hidden: ["A"], camera: "1,2,3", transparency: 40 } });
  for (const other of [source("4pti"), upload]) {
    const { wanted } = act(hidden, { type: "open", source: other });
    assert.deepEqual([values(wanted), wanted.display], [{ isovalue: "2" }, { sticks: true, hidden: [], camera: "", transparency: 40 }]);
  }
  const same = act(hidden, { type: "open", source: source("1crn") }).wanted;
  assert.deepEqual([values(same), same.display], [values(hidden.shown), hidden.shown.display]);
});

test("a display that changes during a request stays", () => {
  const asked = act(shown, set("isovalue", "3"));
  const now = act(asked, { type: "adjust", display: { transparency: 40 } });
  assert.deepEqual([now.shown.display.transparency, values(now.shown)], [40, { isovalue: "2" }]);
  const after = act(now, { type: "shown", request: asked.wanted, source: asked.wanted.source });
  assert.deepEqual([after.shown.display.transparency, after.wanted], [40, null]);
  // The camera of this structure says nothing about the next one.
  const other = act(shown, { type: "open", source: source("4pti") }, { type: "adjust", display: { camera: "1,2,3" } });
  assert.deepEqual([other.shown.display.camera, other.wanted.display.camera], ["1,2,3", ""]);
  // The slider of the transparency shows that of the next structure.
  const changed = act(other, { type: "adjust", display: { transparency: 40 } });
  assert.deepEqual([changed.shown.display.transparency, current(changed).display.transparency], [40, 40]);
});

test("a mesh that arrives while a later one is wanted does not end that request", () => {
  const first = act(shown, set("isovalue", "3"));
  const second = act(first, set("isovalue", "4"));
  const now = act(second, { type: "shown", request: first.wanted, source: first.wanted.source });
  assert.deepEqual([values(now.shown), values(now.wanted)], [{ isovalue: "3" }, { isovalue: "4" }]);
  // It comes without the sticks of the later one, and leaves the camera where it is now.
  const turned = act(first, { type: "sticks", on: true }, { type: "adjust", display: { camera: "1,2,3" } });
  const { shown: view, wanted } = act(turned, { type: "shown", request: first.wanted, source: first.wanted.source });
  assert.deepEqual([view.display.sticks, view.display.camera, wanted?.display.sticks], [false, "1,2,3", true]);
});

test("a structure has its path once it is found", () => {
  const asked = act(shown, { type: "open", source: upload }, set("isovalue", "5"));
  assert.equal(show(asked, source("4pti")).shown.source.name, "4PTI");
});

test("values exclude and need each other", () => {
  const chosen = (...pairs) => pairs.reduce((now, [name, value]) => rules.set(now, name, value), new Map());
  assert.deepEqual([...chosen(["isovalue", "1"], ["resolution", "1"], ["detail", "2"])], [["detail", "2"], ["isovalue", "1"]]);
  assert.deepEqual([...chosen(["color", "bfactor"], ["palette", "viridis"], ["color_blend", "smooth"], ["color", "element"])], [["color", "element"], ["color_blend", "smooth"]]);
  assert.deepEqual([...chosen(["color", "element"], ["color_blend", "smooth"], ["color", undefined])], []);
  assert.deepEqual(rules.missing(chosen(["paper_a", "1"])), ["paper_b"]);
  assert.deepEqual(rules.missing(chosen(["paper_b", "1"])), ["paper_a"]);
  assert.deepEqual(rules.missing(chosen(["paper_b", "1"], ["paper_a", "1"])), []);
});

test("the mesh depends on the colours of vertices only, and files on what their format has", () => {
  const choices = new Map(Object.entries({ isovalue: "2", compress: "none", color: "element", palette: "viridis", instances: "true", width: "300" }));
  const names = (chosen) => [...chosen.keys()].join();
  assert.equal(names(rules.mesh(choices)), "isovalue,compress,instances");
  assert.equal(names(rules.mesh(rules.set(choices, "color_blend", "smooth"))), "isovalue,compress,color,palette,color_blend,instances");
  assert.equal(names(rules.others(choices)), "width");
  assert.equal(names(rules.others(new Map([["color_range", "1,5"]]))), "color_range");
  assert.equal(names(rules.file("stl", choices)), "isovalue,compress,color,palette");
  assert.equal(names(rules.file("png", choices)), "isovalue,color,palette,width");
});

test("a slot keeps the result on the screen, and cancels a request that another one replaces", async () => {
  const slot = new Slot();
  const requests = [];
  const ask = (key, result) => slot.request(key, (_, signal) => (requests.push({ key, signal }), result));
  await ask("a", Promise.resolve(1));
  slot.commit();
  const slow = ask("b", new Promise(() => undefined));
  assert.equal(ask("b"), slow);
  assert.equal(await ask("a"), 1);
  assert.deepEqual(requests.map(({ key, signal }) => [key, signal.aborted]), [["a", false], ["b", true]]);
  await assert.rejects(ask("c", Promise.reject(new Error("refused"))));
  slot.commit();
  assert.equal(await ask("a"), 1);
  assert.equal(await ask("c", Promise.resolve(3)), 3);
  assert.equal(await ask(null), null);
  assert.equal(requests.at(-1).signal.aborted, true);
});
