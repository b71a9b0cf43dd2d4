/** Progress indicator over the surface. */

import type { JobDocument } from "../../client/dist/api";
import { $, show } from "./dom";

/** Delay, ms, before the indicator appears, so that short work does not show it. */
const DELAY = 250;

export class Busy {
  private timer = 0;

  /** Shows what is being done and its progress, from 0 to 1; null if the progress is unknown. */
  show(text: string, fraction: number | null, delay = DELAY): void {
    clearTimeout(this.timer);
    const bar = $<HTMLProgressElement>("progress");
    if (fraction === null) bar.removeAttribute("value");
    else bar.value = fraction;
    $("busy-text").textContent = text;
    $("stage").setAttribute("aria-busy", "true");
    if ($("busy").hidden) this.timer = window.setTimeout(() => show($("busy"), true), delay);
  }

  /** Shows the state of a job. */
  follow({ status, stage, fraction }: JobDocument): void {
    const isQueued = status === "accepted";
    const text = isQueued ? "Waiting in the queue…" : `${stage ?? "meshing"}, ${Math.round(100 * fraction)} %`;
    this.show(text, isQueued ? null : fraction, 0);
  }

  hide(): void {
    clearTimeout(this.timer);
    show($("busy"), false);
    $("stage").removeAttribute("aria-busy");
  }
}
