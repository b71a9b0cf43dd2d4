/** The place of the surface: the viewer, or a picture by the service where the browser has no WebGL or has lost it. */

import type { Client } from "./api/client";
import { asProblem } from "./api/problem";
import { type Choices, surface } from "./request";
import type { Source } from "./api/structures";
import { load, type Loaded } from "./scene/load";
import { contextOf, Viewer } from "./scene/viewer";
import { $, el, show } from "./ui/dom";
import { color } from "./ui/theme";

const ABSENT = "This browser shows no WebGL 2, so the surface cannot be turned here. It is shown as a picture that the server draws; report and downloads are as always.";
const LOST = "The graphics device was lost, for a moment or for good. Until it is back the surface is shown as a picture that the server draws.";

export class Stage {
  readonly viewer: Viewer | null;
  private readonly canvas = $<HTMLCanvasElement>("view");
  private readonly image = $<HTMLImageElement>("picture");
  private readonly notice = $("no-webgl");
  private lost = false;
  private asked: { source: Source; choices: Choices } | null = null;
  private fetching: AbortController | null = null;

  constructor(private readonly client: Client, onTurn: (turning: boolean) => void) {
    const gl = contextOf(this.canvas, false);
    this.viewer = gl && new Viewer(this.canvas, gl, { onTurn, onLost: (lost) => this.onLost(lost) });
    if (!this.viewer) this.explain(ABSENT);
  }

  /** Shows a file; `choices` are those of its picture. Resolves with what it holds, and with the time in the frame after it was drawn. */
  async show(bytes: ArrayBuffer, source: Source, choices: Choices, fresh: boolean): Promise<{ loaded: Loaded; drawn: number }> {
    this.asked = { source, choices };
    const loaded = await load(bytes);
    if (!this.viewer || this.lost) void this.picture();
    const drawn = this.viewer ? await this.viewer.show(loaded, fresh) : performance.now();
    return { loaded, drawn };
  }

  /** Takes the colours of the page. */
  theme(): void {
    this.viewer?.theme(color("--stage"), color("--plain"));
    if (!this.image.hidden) void this.picture();
  }

  private onLost(lost: boolean): void {
    this.lost = lost;
    this.canvas.style.visibility = lost ? "hidden" : "";
    if (lost) {
      this.explain(LOST);
      void this.picture();
    } else {
      show(this.notice, false);
      show(this.image, false);
      this.fetching?.abort();
    }
  }

  private explain(words: string): void {
    this.notice.replaceChildren(el("p", {}, words));
    show(this.notice, true);
  }

  /** Asks for the picture of what would be shown. It is fetched, as an image's own address would carry no key. */
  private async picture(): Promise<void> {
    if (!this.asked) return;
    this.fetching?.abort();
    const abort = (this.fetching = new AbortController());
    const { source, choices } = this.asked;
    const { clientWidth, clientHeight } = $("view-home");
    const pixels = Math.min(2, devicePixelRatio);
    const size = (side: number) => String(Math.max(64, Math.min(2048, Math.round(side * pixels))));
    const path = surface(source, "png", choices, { width: size(clientWidth), height: size(clientHeight) });
    try {
      const reply = await this.client.ask(path, { signal: abort.signal, headers: { accept: "image/png" } });
      const type = reply.headers.get("content-type") ?? "";
      if (reply.status !== 200 || !type.startsWith("image/")) throw new Error("the server sent no picture");
      const blob = await reply.blob();
      if (abort.signal.aborted) return;
      if (this.image.src) URL.revokeObjectURL(this.image.src);
      this.image.src = URL.createObjectURL(blob);
      this.image.alt = `A picture of the surface of ${source.name}`;
      show(this.image, true);
    } catch (error) {
      if (abort.signal.aborted) return;
      show(this.image, false);
      const { document } = asProblem(error);
      const none = document.status === 404 || document.status === 406;
      const words = none ? "This server draws no pictures either; report and downloads work as always." : `The picture could not be had: ${document.detail ?? document.title}`;
      if (!this.notice.querySelector(".hint")) this.notice.append(el("p", { class: "hint" }, words));
    }
  }
}
