/** Controller of the page: asks for views, and describes the one on the screen. */

import { type Client, Problem } from "../client/src/index";
import type { Legend } from "./api/colors";
import { asProblem } from "./api/problem";
import type { Parameter, Schemes } from "./api/schema";
import { entry, pending, type Source, stored, upload } from "./api/structures";
import { Downloads } from "./downloads";
import { drops } from "./drop";
import { keyboard } from "./keyboard";
import type { Mesh } from "./mesh";
import { Picker } from "./picker";
import { Queue, Slot } from "./queue";
import { addressOf, curl, currentAddress, query, readAddress, SAMPLE, surface, writeAddress } from "./request";
import { Rules } from "./rules";
import { Scenes } from "./scenes";
import { Stage, type StageScene } from "./stage";
import { Busy } from "./ui/busy";
import { ColourControls } from "./ui/colours";
import { $, copy, el, number, show } from "./ui/dom";
import { Form } from "./ui/form";
import { listParts } from "./ui/parts";
import { showProblem } from "./ui/problem";
import { type Report, report, sharedReport, storedReport, timingsOf } from "./ui/report";
import { showTiles } from "./ui/tiles";
import { type Action, current, EMPTY, type Failure, PLAIN, reduce, type State, type View } from "./view";

/** Time from input to frame, ms, above which a dragged slider shows a coarser preview. */
const PREVIEW_FROM = 200;

interface ViewRequest {
  view: View;
  /** Grid spacing of a preview, Å; undefined for a full mesh. */
  preview: number | undefined;
  live: boolean;
  since: number;
}

/** Rules and controls from the OpenAPI document of the service. */
interface Service {
  rules: Rules;
  form: Form;
  colours: ColourControls;
  downloads: Downloads;
  scenes: Scenes;
}

export class Page {
  readonly stage: Stage;
  private state: State = EMPTY;
  private service: Service | null = null;
  private readonly picker: Picker | null;
  /** Time from the last input to its frame, ms. */
  private latency = 0;
  private readonly reports = new Slot<Report | null>();
  private readonly queue: Queue<ViewRequest>;
  /** Structures shown so far, by path, so that returning to one needs no second upload. */
  private readonly visited = new Map<string, Source>();
  private explained: Failure | null = null;
  /** True while the page's address names the wanted view, not the one shown. */
  private isAddressed = false;
  /** Timer of the report. */
  private pause = 0;
  private readonly busy = new Busy();

  constructor(private readonly client: Client) {
    this.stage = new Stage(client, {
      turned: (turning) => $("turn").setAttribute("aria-pressed", String(turning)),
      moved: (camera) => this.dispatch({ type: "adjust", display: { camera } }),
      tiles: (state) => showTiles($("now"), state),
      failed: (error, again) => this.fail(error, { view: null, again }),
    });
    const { viewer } = this.stage;
    this.picker = viewer && new Picker(client, viewer, (text) => this.announce(text));
    const { picker } = this;
    keyboard($("view-home"), () => viewer, { Home: () => viewer?.reset(), Enter: () => picker?.pinMiddle(), Escape: () => picker?.release() });
    for (const id of ["turn", "home", "colour", "display"]) show($(id), viewer !== null);
    $("turn").addEventListener("click", () => viewer?.turn(!viewer.isTurning, true));
    $("home").addEventListener("click", () => viewer?.reset());
    this.queue = new Queue((request, signal) => this.run(request, signal), (error, { view }) => this.refuse(error, view), () => this.busy.hide());
    this.listen();
  }

  /** The scene of the view on the screen, without previews. */
  private get scene(): StageScene | null {
    return this.service?.scenes.shown ?? null;
  }

  /** Builds the form from the OpenAPI document and opens the structure that the address names. */
  start(parameters: Parameter[], formats: string[], schemes: Schemes, ofTilesets: ReadonlySet<string>): void {
    const rules = new Rules(parameters, schemes);
    const set = (name: string, value: string | undefined, live = false) => this.want({ type: "set", name, value }, live);
    const downloads = new Downloads(this.client, formats, rules, () => this.state.shown, (error) => this.fail(error, { view: null }));
    $("format").replaceChildren(...formats.map((format) => el("option", { value: format }, format)));
    const scenes = new Scenes(this.client, this.stage, this.busy, rules, ofTilesets);
    this.service = { rules, form: new Form(parameters, set), colours: new ColourControls(schemes, set), downloads, scenes };
    this.visit();
  }

  /** Opens the structure that the address names, else the sample, with the parameters of the address. */
  private visit(): void {
    if (!this.service) return;
    const { pdb, structure, choices, display } = readAddress(this.service.rules.names);
    const known = this.visited.get(`/v1/structures/${structure}`);
    const uploaded = () => known ?? pending(`Structure ${structure.slice(0, 8)}`, (signal) => stored(this.client, structure, signal));
    this.want({ type: "open", source: pdb ? entry(pdb) : structure ? uploaded() : this.sample(), choices, display }, false, true);
  }

  private sample(): Source {
    return pending("The sample", async (signal) => {
      const blob = await (await this.client.ask(`/${SAMPLE}`, { signal })).blob();
      return { ...(await upload(this.client, blob, SAMPLE, signal)), isSample: true };
    });
  }

  private listen(): void {
    const take = (file: File) => this.want({ type: "open", source: pending(file.name, (signal) => upload(this.client, file, file.name, signal)) });
    const on = (id: string, type: string, act: (control: HTMLInputElement, event: Event) => void) => {
      const control = $<HTMLInputElement>(id);
      control.addEventListener(type, (event) => act(control, event));
    };
    on("file", "change", (input) => {
      const chosen = input.files?.[0];
      if (chosen) take(chosen);
      input.value = "";
    });
    drops(take);
    on("pdb-form", "submit", (_, event) => {
      event.preventDefault();
      const id = $<HTMLInputElement>("pdb").value.trim();
      if (id) this.want({ type: "open", source: entry(id) });
    });
    on("sample", "click", () => this.openSample());
    on("cancel", "click", () => this.cancel());
    on("reset-all", "click", () => this.want({ type: "reset" }));
    on("by-chain", "change", ({ checked }) => this.want({ type: "set", name: "split", value: checked ? "chain" : undefined }));
    on("sticks", "change", ({ checked }) => this.want({ type: "sticks", on: checked }));
    const setTransparency = (transparency: number, live: boolean) => this.dispatch({ type: "adjust", display: { transparency } }, live);
    on("transparency", "input", ({ valueAsNumber }) => setTransparency(valueAsNumber, true));
    on("transparency", "change", ({ valueAsNumber }) => setTransparency(valueAsNumber, false));
    on("format", "change", () => this.render());
    const copies = (text: string) => void copy(text).then(() => this.announce("Copied"), (error: unknown) => this.fail(error, { view: null }));
    on("copy-curl", "click", () => copies($("curl").textContent ?? ""));
    on("copy-url", "click", () => {
      const { service, state: { shown } } = this;
      const format = $<HTMLSelectElement>("format").value;
      if (service && shown) copies(location.origin + surface(shown.source, format, service.rules.file(format, shown.choices)));
    });
    window.addEventListener("popstate", () => {
      // A step to the surface shown, or to another fragment of its address, opens nothing.
      const { shown } = this.state;
      if (!shown || addressOf(shown) !== currentAddress()) this.visit();
      else if (this.state.wanted) this.cancel();
    });
  }

  private openSample(): void {
    this.want({ type: "open", source: this.sample() });
  }

  /** Changes the state, and then the page. `live` while a slider is dragged. */
  private dispatch(action: Action, live = false, push = false): void {
    this.state = reduce(this.state, action, this.service?.rules ?? null);
    this.render(live, push);
  }

  /** Changes the wanted view and requests it. `isAddressed` if the page's address names it already. */
  private want(action: Action, live = false, isAddressed = false): void {
    const since = performance.now();
    this.isAddressed = isAddressed;
    this.dispatch(action);
    const { wanted: view, shown } = this.state;
    if (!view || !this.service) return;
    // A view that lacks parameters waits for them.
    if (this.service.rules.missing(view.choices).length) return this.stop();
    const isSlow = live && this.scene && this.latency > PREVIEW_FROM && view.source.path === shown?.source.path;
    const spacing = Number(view.choices.get("resolution")) || Number(this.scene?.mesh.loaded.extras["resolution"] ?? 0.5);
    this.busy.show(view.source.find ? `Reading ${view.source.name}…` : "Updating the surface…", null, live ? 600 : undefined);
    this.queue.want({ view, preview: isSlow ? Number((2 * spacing).toPrecision(3)) : undefined, live, since });
  }

  /** Shows a view. The page changes in one step, once everything has arrived. */
  private async run({ view, preview, since }: ViewRequest, signal: AbortSignal): Promise<void> {
    if (!this.service) return;
    const scene = await this.service.scenes.fetch(view, preview, signal);
    signal.throwIfAborted();
    const { shown: previous } = this.state;
    const { mesh, colors } = scene;
    const { extras } = mesh.loaded;
    const before = this.scene;
    const applied = performance.now();
    const drawing = this.stage.show(scene);
    show($("preview"), preview !== undefined);
    $("preview").textContent = preview === undefined ? "" : `preview at ${number(preview, 2)} Å`;
    if (preview === undefined) this.commit(view, scene, previous);
    const finished = performance.now();
    const end = await drawing;
    // Read by web/measure.mjs and the browser tests.
    if (mesh !== before?.mesh) {
      const parts = { answered: mesh.answered - since, received: mesh.received - mesh.answered, drawn: end - mesh.received };
      performance.measure("molmesh:remesh", { start: since, end, detail: { preview: preview ?? null, triangles: extras["triangles"], ...parts } });
    }
    if (colors && colors !== before?.colors) {
      const times = { received: applied - since, applied: finished - applied, drawn: end - finished };
      performance.measure("molmesh:recolor", { start: since, end, detail: { atoms: colors.rgba.length / 4, ...times } });
    }
    if (preview !== undefined || mesh === before?.mesh || this.scene !== scene) return;
    this.latency = end - since;
    if (!mesh.tileset) $("now").textContent += `, ${number(this.latency, 3)} ms from input to frame`;
  }

  /** Makes `view` the one that the page describes. */
  private commit(view: View, scene: StageScene, previous: View | null): void {
    const { mesh } = scene;
    const { extras } = mesh.loaded;
    const source = { ...scene.source, atoms: scene.source.atoms ?? (Number(extras["atoms_in_file"]) || undefined) };
    const isOther = previous?.source.path !== source.path;
    const isNew = mesh !== this.scene?.mesh;
    this.service?.scenes.commit(scene);
    this.visited.set(source.path, source);
    const push = isOther && previous !== null && !this.isAddressed;
    this.dispatch({ type: "shown", request: view, source }, false, push);
    this.service?.downloads.forget();
    if (isOther) this.follow(source);
    if (!isNew) return;
    this.describe(mesh.tileset ? sharedReport(extras, "computing…") : extras);
    $("now").textContent = `${Number(extras["triangles"]).toLocaleString("en")} triangles`;
    if (!previous && !view.display.camera) this.stage.viewer?.turn(true);
    // After a pause without further meshes.
    clearTimeout(this.pause);
    this.pause = window.setTimeout(() => void this.complete(scene), 300);
  }

  /** Fetches the report of the mesh that the buttons download. */
  private async complete({ mesh: { loaded: { extras }, headers, tileset }, mesh, source }: StageScene): Promise<void> {
    const { triangles, area, closed } = extras;
    const measures = [`${Number(triangles).toLocaleString("en")} triangles`, `area ${number(Number(area), 4)} Å²`, closed === true ? "closed" : "not closed"];
    this.announce(`Surface of ${source.name}: ${tileset ? "shown in tiles" : measures.join(", ")}.`);
    const fetched = (_: Mesh, signal: AbortSignal) => (tileset ? this.wholeReport(source, signal) : storedReport(this.client, headers, signal));
    const failed = (error: unknown) => sharedReport(extras, `not available: ${asProblem(error).document.title}`);
    const document = await this.reports.request(mesh, fetched).catch(failed);
    if (document && this.scene?.mesh === mesh) this.describe(document);
  }

  /** Fetches the report of the whole surface, of which tiles are shown, if the service accepts its mesh. */
  private async wholeReport(source: Source, signal: AbortSignal): Promise<Report> {
    const { service, state: { shown } } = this;
    if (!service || !shown) throw new Error("no surface is shown");
    void service.downloads.describe("glb");
    const { problem } = await service.downloads.estimate("glb");
    if (problem) throw new Problem(problem);
    return this.client.json<Report>(`${source.path}/report.json${query(service.rules.file("glb", shown.choices))}`, { signal, headers: { priority: "u=7" } });
  }

  /** Writes the chains, the assemblies and the atom labels of a structure, which no parameter changes. */
  private follow(source: Source): void {
    const { chains, assemblies } = source.summary ?? {};
    const names = chains?.map(({ name }) => name || "_").slice(0, 12).join(",");
    this.service?.form.hint("chains", names ? `all: ${names}` : "all");
    this.service?.form.offer("assembly", assemblies?.map(({ id, copies }) => [id, copies === null ? id : `${id} (copies: ${copies})`]) ?? []);
    void this.picker?.follow(source);
  }

  /** Writes the report of the mesh on the screen. */
  private describe(document: Report): void {
    if (!this.scene) return;
    const { mesh } = this.scene;
    this.service?.form.showValues(document);
    report($("report"), document, timingsOf(mesh.headers, document));
    show($("coarse"), mesh.tileset !== null);
  }

  private cancel(): void {
    this.stop();
    this.dispatch({ type: "cancelled" });
    const { shown } = this.state;
    this.announce(shown ? `Cancelled. The surface shown is that of ${shown.source.name}.` : "Cancelled");
  }

  /** Ends the running request, and shows the full mesh in place of a preview. */
  private stop(): void {
    this.queue.cancel();
    this.service?.scenes.cancel();
    this.busy.hide();
    show($("preview"), false);
    if (this.scene) void this.stage.show(this.scene);
  }

  /** Returns to the surface shown after a request failed. */
  private refuse(error: unknown, view: View): void {
    this.stop();
    this.fail(error, { view, again: () => this.want({ type: "retry", view }) });
  }

  /** Shows an error. */
  fail(error: unknown, failure: Omit<Failure, "problem">): void {
    const problem = asProblem(error);
    this.dispatch({ type: "failed", failure: { ...failure, problem } });
    const { document } = problem;
    this.announce([failure.view?.source.name, document.title, document.detail].filter(Boolean).join(": "));
  }

  /** Writes everything that names or describes the view on the screen; form and menus show the wanted one. */
  private render(live = false, push = false): void {
    const { state, service, scene } = this;
    const { shown, wanted } = state;
    const view = current(state);
    this.renderProblem();
    if (!service) return;
    const { rules, form, colours } = service;
    const choices = view?.choices ?? new Map<string, string>();
    form.render(choices);
    const { sticks, transparency } = view?.display ?? PLAIN;
    $<HTMLInputElement>("by-chain").checked = choices.get("split") === "chain";
    $<HTMLInputElement>("sticks").checked = sticks;
    const slider = $<HTMLInputElement>("transparency");
    slider.value = String(transparency);
    slider.setAttribute("aria-valuetext", `${transparency} %`);
    $("transparency-value").textContent = `${transparency} %`;
    show($("reset-all"), choices.size > 0);
    const missing = rules.missing(choices);
    show($("missing"), missing.length > 0);
    $("missing").textContent = `Also set ${missing.join(" and ")}: the surface needs both values.`;
    const legend = scene?.colors?.legend ?? (scene?.usesFile ? (scene.mesh.loaded.extras["color"] as Legend) : null);
    colours.render(choices, legend);
    for (const control of document.querySelectorAll<HTMLButtonElement>(".needs-surface")) control.disabled = !shown;
    $("structure-name").textContent = shown?.source.name ?? "No surface";
    if (!shown || !scene) return;
    const { source } = shown;
    const { mesh: { loaded: { extras } }, ligands } = scene;
    this.stage.apply(shown.display);
    const hide = (hidden: string[]) => this.dispatch({ type: "adjust", display: { hidden } });
    listParts($("parts"), this.stage.viewer?.partNames ?? [], shown.display.hidden, hide);
    $("structure-title").textContent = source.summary?.title ?? String(extras["title"] ?? "");
    document.title = `${source.name} · molmesh`;
    $("sticks-note").textContent = ligands?.note ?? "";
    show($("joined"), shown.choices.get("instances") === "true");
    const format = $<HTMLSelectElement>("format").value || "glb";
    $("curl").textContent = curl(source, format, rules.file(format, shown.choices), location.origin, this.client.key !== "");
    if (!live && !(wanted && this.isAddressed)) writeAddress(addressOf(shown), push);
  }

  private renderProblem(): void {
    const { failure, shown } = this.state;
    if (failure === this.explained) return;
    this.explained = failure;
    show($("problem"), failure !== null);
    if (!failure) return;
    const name = failure.view?.source.name ?? "";
    const isOther = shown && name && name !== shown.source.name;
    const same = shown && name ? "The surface and its parameters are as they were before." : "";
    const kept = isOther ? `The surface shown is still that of ${shown.source.name}.` : same;
    showProblem($("problem"), failure, kept, {
      set: (parameter, value) => this.want({ type: "set", name: parameter, value, base: failure.view }),
      close: () => this.dispatch({ type: "dismiss" }),
      sample: shown || !this.service ? undefined : () => this.openSample(),
    });
  }

  private announce(text: string): void {
    $("live").textContent = text;
  }
}
