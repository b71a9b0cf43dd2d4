/** Fetches what a view shows. */

import type { MeshParameters } from "../client/dist/api";
import type { Client } from "../client/src/client";
import { Problem } from "../client/src/problem";
import { atomColors, type AtomColors, colorsPath } from "./api/colors";
import { named, type Source, upload } from "./api/structures";
import { isLarge, tilesetOf } from "./large";
import { fetchLigands, type Ligands, ligandsPath } from "./ligands";
import { fetchMesh, type Mesh } from "./mesh";
import { Slot } from "./queue";
import { coarser, drawn, query, surface, UNCACHED } from "./request";
import type { Rules } from "./rules";
import type { Stage, StageScene } from "./stage";
import type { Busy } from "./ui/busy";
import type { View } from "./view";

export class Scenes {
  private readonly sources = new Slot<Source>();
  private readonly meshes = new Slot<Mesh>();
  private readonly colors = new Slot<AtomColors>();
  private readonly ligands = new Slot<Ligands>();
  private readonly pictures = new Slot<Blob | string>();
  private readonly checks = new Slot<unknown>();
  private readonly slots = [this.sources, this.meshes, this.colors, this.ligands, this.pictures, this.checks];
  /** The scene on the screen, without previews. */
  shown: StageScene | null = null;

  /** `ofTilesets` has the names of the parameters that apply to tilesets. */
  constructor(
    private readonly client: Client,
    private readonly stage: Stage,
    private readonly busy: Busy,
    private readonly rules: Rules,
    private readonly ofTilesets: ReadonlySet<string>,
  ) {}

  /** The scene is on the screen. */
  commit(scene: StageScene): void {
    this.shown = scene;
    for (const slot of this.slots) slot.commit();
  }

  /** Cancels all requests. */
  cancel(): void {
    for (const slot of this.slots) slot.cancel();
  }

  /**
   * Fetches the scene of a view, with the grid spacing `preview` if it is set. What is on the screen, or on its way, is
   * not fetched again.
   */
  async fetch(view: View, preview: number | undefined, signal: AbortSignal): Promise<StageScene> {
    const source = (await this.sources.request(view.source.find ?? null, (find, ending) => find(ending))) ?? view.source;
    signal.throwIfAborted();
    return this.prepare({ ...view, source }, preview).catch(async (error: unknown) => {
      const { blob, file } = source;
      // The service stores structures for a limited time; this page still has the bytes.
      if (!blob || !(error instanceof Problem) || !error.is("no-such-structure")) throw error;
      return this.prepare({ ...view, source: { ...source, ...(await upload(this.client, blob, file, signal)) } }, preview);
    });
  }

  private async prepare({ source, choices, display }: View, preview: number | undefined): Promise<StageScene> {
    const { client, rules, stage, shown } = this;
    const taken = preview === undefined ? choices : coarser(choices, preview);
    const path = drawn(source, rules.mesh(taken));
    const shape = drawn(source, rules.shape(taken));
    const ofVertices = rules.coloursVertices(choices);
    // A mesh with colours of its own can also have those of its atoms.
    const known = !ofVertices && shown?.shape === shape ? shown.mesh : null;
    const tileset = preview !== undefined || !stage.viewer || ofVertices ? null : tilesetOf(source, rules.mesh(taken), this.ofTilesets);
    const onProgress = this.busy.follow.bind(this.busy);
    if (known) this.meshes.cancel();
    const isTiled = (headers: Headers) => isLarge(Number(headers.get("molmesh-atoms")), taken);
    const mesh = (_: string, signal: AbortSignal) => fetchMesh(client, { path, tileset, isLarge: isTiled, signal, onProgress, init: UNCACHED });
    const colors = stage.viewer && !ofVertices ? colorsPath(source.path, choices) : null;
    const ligands = stage.viewer && display.sticks ? ligandsPath(source.path, choices) : null;
    const ofPicture = rules.file("png", taken);
    const picture = stage.draws ? null : surface(source, "png", ofPicture);
    // No other request of this view checks these parameters.
    const others = query(rules.others(choices));
    const check = others && others !== shown?.others ? source.path + others : null;
    const parameters: MeshParameters = { ...Object.fromEntries(choices), format: "png" };
    const [loaded, atoms, sticks, image] = await Promise.all([
      known ?? this.meshes.request(path, mesh),
      this.colors.request(colors, (address, signal) => atomColors(client, address, signal)),
      this.ligands.request(ligands, (_, signal) => fetchLigands(client, source.path, choices, signal)),
      this.pictures.request(picture, (_, signal) => stage.picture(source, ofPicture, signal)),
      this.checks.request(check, (_, signal) => client.estimate(named(source), parameters, { signal })),
    ]);
    return { source, shape, others, choices: ofPicture, mesh: loaded, colors: atoms, usesFile: ofVertices, ligands: sticks, picture: image };
  }
}
