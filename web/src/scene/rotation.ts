/** Rotation of the view without input. */

import type { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

/** Duration of the initial rotation, s: one full turn. */
const TURN = 14;
/** Longest step of the rotation, s. Longer pauses between frames do not turn further. */
const MAX_STEP = 0.1;

export class Rotation {
  /** Remaining time, s. */
  private left = 0;
  private readonly reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

  constructor(private readonly controls: OrbitControls, private readonly onTurn: ((turning: boolean) => void) | undefined) {
    controls.autoRotateSpeed = 60 / TURN;
  }

  get isTurning(): boolean {
    return this.left > 0;
  }

  /** Starts or stops the rotation. Unless `byUser`, it turns once, or not at all if reduced motion is preferred. */
  turn(on: boolean, byUser: boolean): void {
    const was = this.controls.autoRotate;
    this.left = !on || (this.reducedMotion.matches && !byUser) ? 0 : byUser ? Number.POSITIVE_INFINITY : TURN;
    this.controls.autoRotate = this.isTurning;
    if (was !== this.isTurning) this.onTurn?.(this.isTurning);
  }

  /** Turns the view of a frame, `step` ms after the last one. Returns true while it turns. */
  frame(step: number): boolean {
    if (!this.isTurning) {
      if (this.controls.autoRotate) this.turn(false, false);
      return false;
    }
    const time = Math.min(step / 1000, MAX_STEP, this.left);
    this.left -= time;
    this.controls.update(time);
    return true;
  }
}
