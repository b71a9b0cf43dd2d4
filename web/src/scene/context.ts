/** Context of a canvas. */

/** Returns a WebGL 2 context of `canvas`, or null if the browser has none. */
export function contextOf(canvas: HTMLCanvasElement, transparent: boolean): WebGL2RenderingContext | null {
  const attributes: WebGLContextAttributes = {
    antialias: true, alpha: transparent, premultipliedAlpha: true, powerPreference: "high-performance", preserveDrawingBuffer: false,
  };
  return canvas.getContext("webgl2", attributes) as WebGL2RenderingContext | null;
}
