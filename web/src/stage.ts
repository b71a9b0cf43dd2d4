/** Display of the surface: the WebGL viewer, or a picture from the service if WebGL is missing or lost. */

import type { Client } from "../client/src/client";
import { asProblem } from "./api/problem";
import { tileFetcher, type TilesetPaths } from "./large";
import { type Choices, surface, UNCACHED } from "./request";
import type { Source } from "./api/structures";
import { load, type Loaded } from "./scene/load";
import { contextOf } from "./scene/context";
import type { TilesState } from "./scene/tiles";
import { Viewer } from "./scene/viewer";
import { $, el, show } from "./ui/dom";
import { listParts } from "./ui/parts";
import { color } from "./ui/theme";

const ABSENT = "This browser has no WebGL 2, so the surface cannot be turned. It is shown as a picture from the server. Report and downloads work as usual.";
const LOST = "The graphics device was lost. Until it is available again, the surface is shown as a picture from the server.";

/** A surface that is ready for display. */
export interface Scene {
  source: Source;
  /** Parameters of its picture. */
  choices: Choices;
  loaded: Loaded;
  /** Tileset whose coarsest tile is `loaded`; null for a whole surface. */
  tileset: TilesetPaths | null;
  /** Its picture, or a message with the reason for its absence; null if the viewer draws it. */
  picture: Blob | string | null;
}

/** Actions of the page. */
export interface StageActions {
  /** Called when the rotation starts or stops. */
  turned(turning: boolean): void;
  /** Called after parts were shown or hidden. */
  partsChanged(): void;
  /** Called in each frame that shows tiles. */
  tiles(state: TilesState): void;
  /** Called if a tile cannot be loaded. */
  failed(error: unknown, again: () => void): void;
}

export class Stage {
  readonly viewer: Viewer | null;
  private readonly canvas = $<HTMLCanvasElement>("view");
  private readonly image = $<HTMLImageElement>("picture");
  private readonly notice = $("no-webgl");
  private readonly parts = $("parts");
  private readonly hint = el("p", { class: "hint" });
  private lost = false;
  /** The shown surface. */
  private scene: Scene | null = null;
  /** The last surface that was not a preview. */
  private kept: Scene | null = null;
  private fetching: AbortController | null = null;

  constructor(private readonly client: Client, private readonly actions: StageActions) {
    const gl = contextOf(this.canvas, false);
    this.viewer = gl && new Viewer(this.canvas, gl, { onTurn: (turning) => actions.turned(turning), onLost: (lost) => this.onLost(lost) });
    if (!this.viewer) this.explain(ABSENT);
  }

  /** Reads a file, and fetches its picture with `choices` if the viewer does not draw. Does not change the display. */
  async prepare(bytes: ArrayBuffer, source: Source, choices: Choices, tileset: TilesetPaths | null, signal: AbortSignal): Promise<Scene> {
    const loaded = await load(bytes);
    return { source, choices, loaded, tileset, picture: this.draws ? null : await this.picture(source, choices, signal) };
  }

  /** Shows a surface at once, and resolves with the time in the frame after it was drawn. */
  show(scene: Scene, fresh: boolean, preview: boolean): Promise<number> {
    this.scene = scene;
    this.fetching?.abort();
    const drawn = this.viewer?.show(scene.loaded, fresh) ?? Promise.resolve(performance.now());
    if (this.viewer) listParts(this.parts, this.viewer, () => this.actions.partsChanged());
    if (scene.tileset) {
      const { client, actions } = this;
      void this.viewer?.refine(scene.tileset.document, tileFetcher(client), (state) => actions.tiles(state), (error, again) => actions.failed(error, again));
    }
    if (!preview) this.kept = scene;
    if (!this.draws) this.showPicture(scene);
    return drawn;
  }

  /** Replaces a preview by the last full surface. */
  restore(): void {
    if (this.kept && this.scene !== this.kept) void this.show(this.kept, false, false);
  }

  /** Applies the colours of the page. */
  theme(): void {
    this.viewer?.theme(color("--stage"), color("--plain"));
    if (!this.image.hidden) void this.redraw();
  }

  /** True if the viewer draws; otherwise pictures from the service are shown. */
  private get draws(): boolean {
    return this.viewer !== null && !this.lost;
  }

  private onLost(lost: boolean): void {
    this.lost = lost;
    this.canvas.style.visibility = lost ? "hidden" : "";
    if (lost) {
      this.explain(LOST);
      void this.redraw();
    } else {
      show(this.notice, false);
      show(this.image, false);
      this.fetching?.abort();
    }
  }

  private explain(words: string): void {
    this.notice.replaceChildren(el("p", {}, words), this.hint);
    show(this.notice, true);
  }

  /** Fetches the picture of the shown surface again. */
  private async redraw(): Promise<void> {
    const { scene } = this;
    if (!scene) return;
    this.fetching?.abort();
    const abort = (this.fetching = new AbortController());
    try {
      scene.picture = await this.picture(scene.source, scene.choices, abort.signal);
    } catch {
      // Another surface is shown, or the viewer draws again.
      return;
    }
    this.showPicture(scene);
  }

  /** Shows the picture of a scene, or the reason for its absence. */
  private showPicture(scene: Scene): void {
    const { picture, source } = scene;
    if (picture === null) {
      // The viewer has stopped drawing since the scene was prepared.
      show(this.image, false);
      return void this.redraw();
    }
    if (this.image.src) URL.revokeObjectURL(this.image.src);
    this.image.removeAttribute("src");
    if (picture instanceof Blob) {
      this.image.src = URL.createObjectURL(picture);
      this.image.alt = `A picture of the surface of ${source.name}`;
    }
    this.hint.textContent = picture instanceof Blob ? "" : picture;
    show(this.hint, !(picture instanceof Blob));
    show(this.image, picture instanceof Blob);
  }

  /**
   * Fetches a picture, or returns a message with the reason for its absence. Uses fetch, since an image element would
   * send no key. Throws only when `signal` is aborted.
   */
  private async picture(source: Source, choices: Choices, signal: AbortSignal): Promise<Blob | string> {
    const { clientWidth, clientHeight } = $("view-home");
    const pixels = Math.min(2, devicePixelRatio);
    const size = (side: number) => String(Math.max(64, Math.min(2048, Math.round(side * pixels))));
    const path = surface(source, "png", choices, { width: size(clientWidth), height: size(clientHeight) });
    try {
      const reply = await this.client.file(path, { signal, init: UNCACHED });
      if (!(reply.headers.get("content-type") ?? "").startsWith("image/")) throw new Error("the server sent no picture");
      return await reply.blob();
    } catch (error) {
      signal.throwIfAborted();
      const { document } = asProblem(error);
      const none = document.status === 404 || document.status === 406;
      return none
        ? "This server does not render pictures. Report and downloads work as usual."
        : `The picture could not be loaded: ${document.detail ?? document.title}`;
    }
  }
}
