/** Downloads of the shown surface in every format, identical to the response of the API, with their sizes. */

import type { EstimateDocument, JobDocument, MeshParameters } from "../client/dist/api";
import type { Client } from "../client/src/client";
import { named, type Source } from "./api/structures";
import { stem, surface, UNCACHED } from "./request";
import type { Choices, Rules } from "./rules";
import { $, bytes, el, number } from "./ui/dom";

/** Size, bytes, above which the page offers smaller files. */
const LARGE = 100e6;
/** Parameters of smaller files. */
const SMALLER: readonly (readonly [string, string, string])[] = [["1 Å", "resolution", "1"], ["meshopt", "compress", "meshopt"]];

export class Downloads {
  /** Estimates of the shown surface, by path. */
  private readonly estimates = new Map<string, Promise<EstimateDocument>>();
  /** Path of the file that the page describes. */
  private described = "";

  constructor(
    private readonly client: Client,
    formats: string[],
    private readonly rules: Rules,
    private readonly shown: () => { source: Source; choices: Choices } | null,
    private readonly failed: (error: unknown) => void,
  ) {
    const buttons = formats.map((format) => {
      const label = `Download as ${format.toUpperCase()}`;
      const button = el("button", { type: "button", "data-format": format, "aria-label": label, "aria-describedby": "size" }, format);
      button.addEventListener("click", () => void this.save(format, button));
      for (const event of ["pointerenter", "focus"]) button.addEventListener(event, () => void this.describe(format));
      return button;
    });
    $("formats").replaceChildren(...buttons);
  }

  /** Forgets the sizes of the previous surface. */
  forget(): void {
    this.estimates.clear();
    this.described = "";
    $("size").replaceChildren();
  }

  /** Estimates a file of the shown surface, with another value of one parameter. */
  async estimate(format: string, name?: string, value?: string): Promise<EstimateDocument> {
    const file = this.file(format, name, value);
    if (!file) throw new Error("there is no surface");
    const { path, source, choices } = file;
    const known = this.estimates.get(path) ?? this.client.estimate(named(source), { ...Object.fromEntries(choices), format } as MeshParameters);
    this.estimates.set(path, known);
    // The same request may succeed later.
    known.catch(() => this.estimates.delete(path));
    return known;
  }

  /** Shows the size of a file, and smaller files beside a large one. Shows nothing if the service gives none. */
  async describe(format: string): Promise<void> {
    const path = this.file(format)?.path ?? "";
    if (path === this.described) return;
    this.described = path;
    const isCurrent = () => this.described === path;
    $("size").replaceChildren();
    const { accepted, mesh_bytes: size, triangles, problem } = await this.estimate(format).catch(() => NOTHING);
    if (!isCurrent() || size === 0) return;
    const amount = `about ${number(triangles ?? 0, 2)} triangles, ${bytes(size ?? 0)}`;
    $("size").textContent = `${format.toUpperCase()}: ${accepted ? amount : (problem?.title ?? "")}`;
    if (accepted && (size ?? 0) < LARGE) return;
    for (const [label, name, value] of SMALLER) {
      if (name === "compress" && !format.startsWith("gl")) continue;
      const smaller = await this.estimate(format, name, value).catch(() => NOTHING);
      if (!isCurrent()) return;
      if (!smaller.accepted || !smaller.mesh_bytes || smaller.mesh_bytes >= (size ?? Infinity)) continue;
      const button = el("button", { type: "button" }, `${label}: ${bytes(smaller.mesh_bytes)}`);
      button.addEventListener("click", () => void this.save(format, button, name, value));
      $("size").append(" ", button);
    }
  }

  /** Returns the path of a file and what it is made from, with another value of one parameter. */
  private file(format: string, name?: string, value?: string) {
    const { shown } = this;
    const view = shown();
    if (!view) return null;
    const { source } = view;
    const choices = this.rules.file(format, name === undefined ? view.choices : this.rules.set(view.choices, name, value));
    return { path: surface(source, format, choices), source, choices };
  }

  private async save(format: string, button: HTMLButtonElement, name?: string, value?: string): Promise<void> {
    const file = this.file(format, name, value);
    if (!file) return;
    const status = $("saved");
    button.disabled = true;
    status.textContent = `Making the ${format.toUpperCase()}…`;
    try {
      const onProgress = ({ fraction }: JobDocument) => (status.textContent = `Making the ${format.toUpperCase()}: ${Math.round(100 * fraction)} %`);
      const reply = await this.client.file(file.path, { onProgress, init: UNCACHED });
      const blob = await reply.blob();
      const saved = /filename="([^"]+)"/.exec(reply.headers.get("content-disposition") ?? "")?.[1] ?? `${stem(file.source)}.${format}`;
      const url = URL.createObjectURL(blob);
      const link = el("a", { href: url, download: saved });
      link.click();
      // The browser has saved the file by then.
      setTimeout(() => URL.revokeObjectURL(url), 60_000);
      status.textContent = `${saved}, ${bytes(blob.size)}`;
    } catch (error) {
      status.textContent = "";
      this.failed(error);
    } finally {
      button.disabled = false;
    }
  }
}

/** Estimate of a service that gives none. */
const NOTHING = { accepted: false, mesh_bytes: 0, triangles: null, problem: null };
