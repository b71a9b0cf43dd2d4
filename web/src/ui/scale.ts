/** Mapping between values and slider positions, logarithmic if the range is wide and positive. */

export const STEPS = 1000;

export class Scale {
  private readonly logarithmic: boolean;

  constructor(readonly low: number, readonly high: number, private readonly whole: boolean) {
    this.logarithmic = low > 0 && high / low >= 8;
  }

  /** Number of steps of the slider. */
  get steps(): number {
    const span = this.high - this.low;
    return this.whole && !this.logarithmic && span <= STEPS ? span : STEPS;
  }

  value(position: number): number {
    const t = position / this.steps;
    const raw = this.logarithmic ? this.low * (this.high / this.low) ** t : this.low + (this.high - this.low) * t;
    if (this.whole) return Math.round(raw);
    // Dragging cannot set more than three digits.
    const digits = this.logarithmic ? Number(raw.toPrecision(3)) : Number(raw.toFixed(Math.max(0, 2 - Math.floor(Math.log10(this.high - this.low)))));
    return Math.min(this.high, Math.max(this.low, digits));
  }

  position(value: number): number {
    const within = Math.min(this.high, Math.max(this.low, value));
    const t = this.logarithmic ? Math.log(within / this.low) / Math.log(this.high / this.low) : (within - this.low) / (this.high - this.low);
    return Math.round(t * this.steps);
  }
}
