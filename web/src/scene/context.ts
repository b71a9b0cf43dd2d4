/** Context of a canvas, and settings of its viewer. */

/** Returns a WebGL 2 context of `canvas`, or null if the browser has none. */
export function contextOf(canvas: HTMLCanvasElement, transparent: boolean): WebGL2RenderingContext | null {
  const attributes: WebGLContextAttributes = {
    antialias: true, alpha: transparent, premultipliedAlpha: true, powerPreference: "high-performance", preserveDrawingBuffer: false,
  };
  return canvas.getContext("webgl2", attributes) as WebGL2RenderingContext | null;
}

/** Maximum transparency of a surface, per cent. */
const MAX_TRANSPARENCY = 90;

/** Returns a transparency in per cent, 0 to 90; 0 if the text is no number. */
export function transparencyOf(text: string | null): number {
  const value = Number(text);
  return Number.isFinite(value) ? Math.min(MAX_TRANSPARENCY, Math.max(0, Math.round(value))) : 0;
}

/** Settings of a viewer. */
export interface ViewerOptions {
  /** True for a transparent background. */
  transparent?: boolean;
  /** Called when the context is lost (true) or restored (false). */
  onLost?: (lost: boolean) => void;
  /** Called when the rotation starts or stops. */
  onTurn?: (turning: boolean) => void;
}
