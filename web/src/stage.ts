/** Display of the surface: the WebGL viewer, or a picture from the service if WebGL is missing or lost. */

import type { Client } from "../client/src/client";
import { asProblem } from "./api/problem";
import { tileFetcher } from "./large";
import { draw, type Scene } from "./mesh";
import { surface, UNCACHED } from "./request";
import type { Choices } from "./rules";
import type { Source } from "./api/structures";
import { contextOf } from "./scene/context";
import type { TilesState } from "./scene/tiles";
import { cameraText, parseCamera } from "./scene/camera";
import { Viewer } from "./scene/viewer";
import { $, el, show } from "./ui/dom";
import { color } from "./ui/theme";
import { type Display, PLAIN } from "./view";

/** Time without movement, ms, after which the address contains the camera. Browsers limit its changes per second. */
const REST = 300;

const ABSENT = "This browser has no WebGL 2, so the surface cannot be turned. It is shown as a picture from the server. Report and downloads work as usual.";
const LOST = "The graphics device was lost. Until it is available again, the surface is shown as a picture from the server.";

/** A surface that is ready for display. */
export interface StageScene extends Scene {
  source: Source;
  /** Path of its mesh without colours. */
  shape: string;
  /** Parameters that neither its mesh nor its colours depend on, as a query. */
  others: string;
  /** Parameters of its picture. */
  choices: Choices;
  /** Its picture, or a message with the reason for its absence; null if the viewer draws it. */
  picture: Blob | string | null;
}

/** Actions of the page. */
export interface StageActions {
  /** Called when the rotation starts or stops. */
  turned(turning: boolean): void;
  /** Called when the camera has come to rest, with its position as text. */
  moved(camera: string): void;
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
  private readonly hint = el("p", { class: "hint" });
  private lost = false;
  /** The scene on the screen. */
  private scene: StageScene | null = null;
  private display = PLAIN;
  private rest = 0;
  private fetching: AbortController | null = null;

  constructor(private readonly client: Client, private readonly actions: StageActions) {
    const gl = contextOf(this.canvas, false);
    this.viewer = gl && new Viewer(this.canvas, gl, { onTurn: (turning) => actions.turned(turning), onLost: (lost) => this.onLost(lost) });
    if (!this.viewer) this.explain(ABSENT);
    this.viewer?.controls.addEventListener("change", () => {
      clearTimeout(this.rest);
      this.rest = window.setTimeout(() => this.rested(), REST);
    });
  }

  /** True if the viewer draws; otherwise pictures from the service are shown. */
  get draws(): boolean {
    return this.viewer !== null && !this.lost;
  }

  /** Shows a scene at once, and resolves with the time in the frame after it was drawn. */
  show(scene: StageScene): Promise<number> {
    const { scene: previous, viewer, client, actions } = this;
    // The camera is relative to its surface.
    if (this.rest && !viewer?.isTurning) this.rested();
    this.scene = scene;
    this.fetching?.abort();
    const isOther = scene.source.path !== previous?.source.path;
    const drawn = viewer ? draw(viewer, scene, previous, isOther) : Promise.resolve(performance.now());
    if (isOther) this.display = { ...this.display, camera: "" };
    const { tileset } = scene.mesh;
    if (tileset && scene.mesh !== previous?.mesh) {
      void viewer?.refine(tileset.document, tileFetcher(client), (state) => actions.tiles(state), (error, again) => actions.failed(error, again));
    }
    if (!this.draws) this.showPicture(scene);
    return drawn;
  }

  /** Applies the display of the surface on the screen. The camera moves only if `display` has another one. */
  apply(display: Display): void {
    const { viewer, display: previous } = this;
    if (!viewer || display === previous) return;
    this.display = display;
    viewer.hideParts(display.hidden);
    viewer.setTransparency(display.transparency / 100);
    if (display.camera !== previous.camera) viewer.view = parseCamera(display.camera);
  }

  private rested(): void {
    clearTimeout(this.rest);
    this.rest = 0;
    const camera = this.viewer ? cameraText(this.viewer.view) : "";
    if (camera === this.display.camera) return;
    this.display = { ...this.display, camera };
    this.actions.moved(camera);
  }

  /** Applies the colours of the page. */
  theme(): void {
    this.viewer?.theme(color("--stage"), color("--plain"));
    if (!this.image.hidden) void this.redraw();
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
  private showPicture(scene: StageScene): void {
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
  async picture(source: Source, choices: Choices, signal: AbortSignal): Promise<Blob | string> {
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
