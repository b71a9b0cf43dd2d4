/** Controller of the page: asks for views, and describes the one on the screen. */

import { type Client, Problem } from "../client/src/index";
import { atomColors, type AtomColors, colorsPath, type Legend } from "./api/colors";
import { asProblem } from "./api/problem";
import type { Parameter, Schemes } from "./api/schema";
import { entry, named, pending, type Source, stored, upload } from "./api/structures";
import { connect } from "./controls";
import { Downloads } from "./downloads";
import { keyboard } from "./keyboard";
import { isLarge, tilesetOf } from "./large";
import { fetchLigands, type Ligands, ligandsPath } from "./ligands";
import { fetchMesh, type Mesh } from "./mesh";
import { Picker } from "./picker";
import { Queue, Slot } from "./queue";
import { addressOf, coarser, curl, currentAddress, drawn, query, readAddress, SAMPLE, surface, UNCACHED, writeAddress } from "./request";
import { Rules } from "./rules";
import { Stage, type StageScene } from "./stage";
import { Busy } from "./ui/busy";
import { ColourControls } from "./ui/colours";
import { $, el, number, show } from "./ui/dom";
import { Form } from "./ui/form";
import { listParts } from "./ui/parts";
import { showProblem } from "./ui/problem";
import { type Report, report, storedReport, timingsOf } from "./ui/report";
import { showTiles } from "./ui/tiles";
import { type Action, current, EMPTY, type Failure, PLAIN, reduce, type State, type View } from "./view";

/** Time from input to frame, ms, above which a dragged slider shows a coarser preview. */
const PREVIEW_FROM = 200;

interface Request {
  view: View;
  /** Grid spacing of a preview, Å; undefined for a full mesh. */
  preview: number | undefined;
  live: boolean;
  since: number;
}

/** What the OpenAPI document of the service defines. */
interface Service {
  rules: Rules;
  form: Form;
  colours: ColourControls;
  /** Names of the parameters that apply to tilesets. */
  ofTilesets: ReadonlySet<string>;
}

export class Page {
  readonly stage: Stage;
  private state: State = EMPTY;
  private service: Service | null = null;
  private readonly picker: Picker | null;
  /** The scene of the view on the screen, without previews. */
  private scene: StageScene | null = null;
  /** Time from the last input to its frame, ms. */
  private took = 0;
  private readonly sources = new Slot<Source>();
  private readonly meshes = new Slot<Mesh>();
  private readonly colors = new Slot<AtomColors | null>();
  private readonly ligands = new Slot<Ligands | null>();
  private readonly pictures = new Slot<Blob | string | null>();
  private readonly checks = new Slot<unknown>();
  private readonly slots = [this.sources, this.meshes, this.colors, this.ligands, this.pictures, this.checks];
  private readonly queue: Queue<Request>;
  /** Structures shown so far, by path, so that returning to one needs no second upload. */
  private readonly visited = new Map<string, Source>();
  private explained: Failure | null = null;
  private facts = 0;
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
    if (viewer && this.picker) keyboard($("view-home"), viewer, this.picker);
    for (const id of ["turn", "home", "colour", "display"]) show($(id), viewer !== null);
    $("turn").addEventListener("click", () => viewer?.turn(!viewer.isTurning, true));
    $("home").addEventListener("click", () => viewer?.reset());
    this.queue = new Queue({
      run: (request, signal) => this.run(request, signal),
      failed: (error, { view }) => this.refuse(error, view),
      idle: () => this.busy.hide(),
    });
    this.listen();
  }

  /** Builds the form from the OpenAPI document and opens the structure that the address names. */
  start(parameters: Parameter[], formats: string[], schemes: Schemes, ofTilesets: ReadonlySet<string>): void {
    const rules = new Rules(parameters, schemes);
    const set = (name: string, value: string | undefined, live = false) => this.want({ type: "set", name, value }, live);
    const file = (format: string) => this.state.shown && { source: this.state.shown.source, choices: rules.file(format, this.state.shown.choices) };
    new Downloads(this.client, formats, file, (error) => this.fail(error, { view: null }));
    $("format").replaceChildren(...formats.map((format) => el("option", { value: format }, format)));
    this.service = { rules, form: new Form(parameters, set), colours: new ColourControls(schemes, set), ofTilesets };
    this.visit();
  }

  /** Opens the structure that the address names, else the sample, with the parameters of the address. */
  private visit(): void {
    if (!this.service) return;
    const { pdb, structure, choices, display } = readAddress(this.service.rules.names);
    const known = this.visited.get(`/v1/structures/${structure}`);
    const uploaded = () => known ?? pending(`Structure ${structure.slice(0, 8)}`, (signal) => stored(this.client, structure, signal));
    this.want({ type: "open", source: pdb ? entry(pdb) : structure ? uploaded() : this.sample(), choices, display });
  }

  private sample(): Source {
    return pending("The sample", async (signal) => {
      const blob = await (await this.client.ask(`/${SAMPLE}`, { signal })).blob();
      return { ...(await upload(this.client, blob, SAMPLE, signal)), isSample: true };
    });
  }

  private listen(): void {
    connect({
      openFile: (file) => this.want({ type: "open", source: pending(file.name, (signal) => upload(this.client, file, file.name, signal)) }),
      openEntry: (id) => this.want({ type: "open", source: entry(id) }),
      openSample: () => this.openSample(),
      cancel: () => this.cancel(),
      reset: () => this.want({ type: "reset" }),
      divide: (byChain) => this.want({ type: "set", name: "split", value: byChain ? "chain" : undefined }),
      setSticks: (on) => this.want({ type: "sticks", on }),
      setTransparency: (transparency, live) => this.dispatch({ type: "adjust", display: { transparency } }, live),
      formatChanged: () => this.render(),
      address: () => {
        const format = $<HTMLSelectElement>("format").value;
        const { shown } = this.state;
        return shown && this.service ? location.origin + surface(shown.source, format, this.service.rules.file(format, shown.choices)) : "";
      },
      copied: () => this.announce("Copied"),
      copyFailed: (error) => this.fail(error, { view: null }),
    });
    window.addEventListener("popstate", () => {
      // A step to another fragment of the same address opens nothing.
      const { shown } = this.state;
      if (!shown || addressOf(shown) !== currentAddress()) this.visit();
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

  /** Changes the wanted view and requests it. */
  private want(action: Action, live = false): void {
    const since = performance.now();
    this.dispatch(action);
    const { wanted: view, shown } = this.state;
    if (!view || !this.service) return;
    // A view that lacks parameters waits for them.
    if (this.service.rules.missing(view.choices).length) return this.stop();
    const isSlow = live && this.scene && this.took > PREVIEW_FROM && view.source.path === shown?.source.path;
    const spacing = Number(view.choices.get("resolution")) || Number(this.scene?.mesh.loaded.extras["resolution"] ?? 0.5);
    this.busy.show(view.source.find ? `Reading ${view.source.name}…` : "Meshing…", null, live ? 600 : undefined);
    this.queue.want({ view, preview: isSlow ? Number((2 * spacing).toPrecision(3)) : undefined, live, since });
  }

  private async run(request: Request, signal: AbortSignal): Promise<void> {
    const { view, preview } = request;
    const { find } = view.source;
    if (!find) this.sources.cancel();
    const source = find ? await this.sources.request(view.source, find) : view.source;
    signal.throwIfAborted();
    const prepare = (from: Source) => this.prepare({ ...view, source: from }, preview);
    const scene = await prepare(source).catch(async (error: unknown) => {
      const { blob, file } = source;
      // The service stores structures for a limited time; this page still has the bytes.
      if (!blob || !(error instanceof Problem) || !error.is("no-such-structure")) throw error;
      return prepare({ ...source, ...(await upload(this.client, blob, file, signal)) });
    });
    signal.throwIfAborted();
    await this.show(request, scene);
  }

  /** Fetches what a view shows. What is on the screen, or on its way, is not fetched again. */
  private async prepare({ source, choices, display }: View, preview?: number): Promise<StageScene> {
    const { client, service, stage } = this;
    if (!service) throw new Error("the page has not started");
    const { rules, ofTilesets } = service;
    const taken = preview === undefined ? choices : coarser(choices, preview);
    const path = drawn(source, rules.mesh(taken));
    const shape = drawn(source, rules.shape(taken));
    const ofVertices = rules.coloursVertices(choices);
    // A mesh with colours of its own can also have those of its atoms.
    const known = !ofVertices && this.scene?.shape === shape ? this.scene.mesh : null;
    const tileset = preview !== undefined || !stage.viewer || ofVertices ? null : tilesetOf(source, rules.mesh(taken), ofTilesets);
    const onProgress = this.busy.follow.bind(this.busy);
    if (known) this.meshes.cancel();
    const mesh = (signal: AbortSignal) =>
      fetchMesh(client, { path, tileset, isLarge: (headers) => isLarge(Number(headers.get("molmesh-atoms")), taken), signal, onProgress, init: UNCACHED });
    const colors = stage.viewer && !ofVertices ? colorsPath(source.path, choices) : null;
    const ligands = stage.viewer && display.sticks ? ligandsPath(source.path, choices) : null;
    const ofPicture = rules.file("png", taken);
    const picture = stage.draws ? null : surface(source, "png", ofPicture);
    // No other request of this view checks these parameters.
    const unchecked = query(rules.others(choices));
    const check = unchecked && unchecked !== query(rules.others(this.state.shown?.choices ?? new Map())) ? source.path + unchecked : null;
    const [loaded, atoms, sticks, image] = await Promise.all([
      known ?? this.meshes.request(path, mesh),
      this.colors.request(colors, async (signal) => (colors ? atomColors(client, colors, signal) : null)),
      this.ligands.request(ligands, async (signal) => (ligands ? fetchLigands(client, source.path, choices, signal) : null)),
      this.pictures.request(picture, async (signal) => (picture ? stage.picture(source, ofPicture, signal) : null)),
      this.checks.request(check, async (signal) => check && client.estimate(named(source), { ...Object.fromEntries(choices), format: "png" }, { signal })),
    ]);
    return { source, shape, choices: ofPicture, mesh: loaded, colors: atoms, usesFile: ofVertices, ligands: sticks, picture: image };
  }

  /** Shows a scene. The page changes in one step, once everything is ready. */
  private async show({ view, preview, since }: Request, scene: StageScene): Promise<void> {
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
    this.took = end - since;
    if (!mesh.tileset) $("now").textContent += `, ${number(this.took, 3)} ms from input to frame`;
  }

  /** Makes `view` the one that the page describes. */
  private commit(view: View, scene: StageScene, previous: View | null): void {
    const { mesh } = scene;
    const { extras } = mesh.loaded;
    const source = { ...scene.source, atoms: scene.source.atoms ?? (Number(extras["atoms_in_file"]) || undefined) };
    const isOther = previous?.source.path !== source.path;
    const isNew = mesh !== this.scene?.mesh;
    this.scene = scene;
    for (const slot of this.slots) slot.commit();
    this.visited.set(source.path, source);
    // After a step through the history, the address is already set.
    const push = isOther && previous !== null && addressOf(previous) === currentAddress();
    this.dispatch({ type: "shown", request: view, source }, false, push);
    if (isOther) this.follow(source);
    if (!isNew) return;
    this.describe(extras);
    $("now").textContent = `${Number(extras["triangles"]).toLocaleString("en")} triangles`;
    if (!previous && !view.display.camera) this.stage.viewer?.turn(true);
    // After a pause without further meshes.
    clearTimeout(this.facts);
    this.facts = window.setTimeout(() => void this.complete(scene), 300);
  }

  private async complete({ mesh: { loaded: { extras }, headers }, mesh, source }: StageScene): Promise<void> {
    const closed = extras["closed"] === true ? "closed" : "not closed";
    this.announce(`Surface of ${source.name}: ${Number(extras["triangles"]).toLocaleString("en")} triangles, area ${number(Number(extras["area"]), 4)} Å², ${closed}.`);
    const document = await storedReport(this.client, headers);
    if (document && this.scene?.mesh === mesh) this.describe(document);
  }

  /** Writes what belongs to a structure, whatever its surface is. */
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
    this.service?.form.showValues(mesh.tileset ? { ...document, resolution: undefined } : document);
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
    for (const slot of this.slots) slot.cancel();
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

  /** Hides the error message. */
  dismiss(): void {
    this.dispatch({ type: "dismiss" });
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
    listParts($("parts"), this.stage.viewer?.partNames ?? [], shown.display.hidden, (hidden) => this.dispatch({ type: "adjust", display: { hidden } }));
    $("structure-title").textContent = source.summary?.title ?? String(extras["title"] ?? "");
    document.title = `${source.name} · molmesh`;
    $("sticks-note").textContent = ligands?.note ?? "";
    show($("joined"), shown.choices.get("instances") === "true");
    const format = $<HTMLSelectElement>("format").value || "glb";
    $("curl").textContent = curl(source, format, rules.file(format, shown.choices), location.origin, this.client.key !== "");
    // The address of a step through the history stays until its view is shown or refused.
    if (!live && (!wanted || missing.length)) writeAddress(addressOf(shown), push);
  }

  private renderProblem(): void {
    const { failure, shown } = this.state;
    if (failure === this.explained) return;
    this.explained = failure;
    show($("problem"), failure !== null);
    if (!failure) return;
    const name = failure.view?.source.name ?? "";
    const isOther = shown && name && name !== shown.source.name;
    const kept = isOther ? `The surface shown is still that of ${shown.source.name}.` : shown && name ? "The surface and its parameters are as they were before." : "";
    showProblem($("problem"), failure, kept, {
      set: (parameter, value) => this.want({ type: "set", name: parameter, value, base: failure.view }),
      close: () => this.dismiss(),
      sample: shown || !this.service ? undefined : () => this.openSample(),
    });
  }

  private announce(text: string): void {
    $("live").textContent = text;
  }
}
