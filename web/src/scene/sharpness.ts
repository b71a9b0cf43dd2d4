/** Resolution of a canvas: lower during slow motion, so that it stays smooth without a GPU, and full at rest. */

import type { WebGLRenderer } from "three";

/** Maximum device pixels per CSS pixel. More is not visible. */
const MAX_PIXEL_RATIO = 2;
/** Frame time, ms, above which the resolution is reduced during motion. */
const SLOW = 40;
/** Time without a frame, ms, after which motion has ended. */
const PAUSE = 200;

export class Sharpness {
  /** Resolution as a fraction of the full one. */
  private fraction = 1;
  /** Smoothed frame time, ms. */
  private slowness = 0;
  private settle = 0;

  /** `rest` draws again after the end of motion. */
  constructor(private readonly renderer: WebGLRenderer, private readonly rest: () => void) {}

  /** Sets the resolution of a frame, `step` ms after the last one. */
  frame(step: number, turning: boolean): void {
    if (step < 500) this.slowness += 0.3 * (step - this.slowness);
    const moving = step < 250;
    const wanted = moving && this.slowness > SLOW ? Math.max(0.5, Math.sqrt(SLOW / this.slowness)) : 1;
    const next = Math.round(wanted * 4) / 4;
    if (next !== this.fraction) {
      this.fraction = next;
      this.apply();
    }
    clearTimeout(this.settle);
    if (turning || this.fraction === 1) return;
    this.settle = window.setTimeout(() => {
      this.slowness = 0;
      this.rest();
    }, PAUSE);
  }

  /** Applies the resolution to the canvas. */
  apply(): void {
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO) * this.fraction);
  }
}
