/** Viewer of a surface on a canvas. Draws only when something has changed. */

import { type BufferGeometry, type DataTexture, Mesh, PerspectiveCamera, Raycaster, Scene, SRGBColorSpace, Vector2, WebGLRenderer } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { ViewerOptions } from "./context";
import { type Loaded, type Part, unitScale } from "./load";
import { depthLayer, depthsOnly, SurfaceMaterial } from "./material";
import { type Hit, pick, placeOf } from "./pick";
import { Rotation } from "./rotation";
import { Sharpness } from "./sharpness";
import { type Rows, Style } from "./style";
import type { FetchTile, Tiles, TilesState } from "./tiles";
import { bound, type CameraView, FRONT, moved, place, viewOf } from "./camera";

export class Viewer {
  readonly controls: OrbitControls;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(28, 1, 0.1, 1000);
  /** One mesh per part. They share a material. */
  private meshes: Mesh[] = [];
  private material: SurfaceMaterial | null = null;
  /** Material that writes only depths. */
  private depths: SurfaceMaterial | null = null;
  private sticks: { mesh: Mesh; material: SurfaceMaterial } | null = null;
  private transparency = 0;
  /** Names of hidden parts. */
  private readonly hidden = new Set<string>();
  private loaded: Loaded | null = null;
  private readonly style = new Style();
  private frame = 0;
  private lastFrame = 0;
  private readonly sharpness: Sharpness;
  private readonly rotation: Rotation;
  /** Tiles that replace the surface where they are loaded. */
  private tiles: Tiles | null = null;
  private onTiles: (state: TilesState) => void = () => undefined;
  private readonly size = new ResizeObserver(() => this.resize());

  /** Creates a viewer on `canvas` with the context `gl`. */
  constructor(readonly canvas: HTMLCanvasElement, gl: WebGL2RenderingContext, private readonly options: ViewerOptions = {}) {
    this.renderer = new WebGLRenderer({ canvas, context: gl, antialias: true, alpha: options.transparent ?? false });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.sharpness = new Sharpness(this.renderer, () => this.rest());
    this.controls = new OrbitControls(this.camera, canvas);
    this.rotation = new Rotation(this.controls, options.onTurn);
    this.controls.addEventListener("change", () => this.invalidate());
    this.controls.addEventListener("start", () => this.turn(false));
    canvas.addEventListener("webglcontextlost", () => options.onLost?.(true));
    canvas.addEventListener("webglcontextrestored", () => {
      options.onLost?.(false);
      // The restored context lacks the clear colour. three.js restores everything else.
      this.clear();
      this.invalidate();
    });
    this.size.observe(canvas);
    this.resize();
  }

  /** Shows a surface. Resets the view if `fresh`. Resolves in the frame after the one that shows it. */
  show(loaded: Loaded, fresh: boolean): Promise<number> {
    const isFirst = !this.loaded;
    this.scene.remove(...this.meshes);
    this.release();
    const [{ geometry: first }] = loaded.parts as [Loaded["parts"][0]];
    const material = (this.material = new SurfaceMaterial(first, loaded.twoSided));
    this.depths = depthsOnly(first, loaded.twoSided);
    this.meshes = loaded.parts.map(({ name, geometry, matrix }) => {
      const mesh = new Mesh(geometry, material);
      mesh.matrixAutoUpdate = false;
      mesh.matrix.copy(matrix);
      mesh.frustumCulled = false;
      mesh.visible = !this.hidden.has(name);
      return mesh;
    });
    this.loaded = loaded;
    this.scene.add(...this.meshes);
    this.restyle();
    this.prepareMeshes(this.meshes);
    this.applyTransparency();
    if (fresh || isFirst) this.reset();
    else this.clip();
    return this.drawn();
  }

  /**
   * Shows the tileset at `url` in place of the surface, which is its root. Loads the tiles that the view needs, and
   * calls `changed` in every frame that shows tiles.
   */
  async refine(url: string, fetchTile: FetchTile, changed: (state: TilesState) => void, failed: (error: unknown, retry: () => void) => void): Promise<void> {
    const { loaded } = this;
    const { Tiles } = await import("./tiles");
    // Another surface may be shown now.
    if (this.loaded !== loaded) return;
    const tiles = new Tiles(url, fetchTile, {
      loaded: (meshes) => this.prepareMeshes(meshes),
      invalidate: () => this.invalidate(),
      failed: (error) => failed(error, () => tiles.retry()),
    });
    [this.tiles, this.onTiles] = [tiles, changed];
    this.scene.add(tiles.group);
    this.clip();
    this.invalidate();
  }

  /** Prepares meshes of the surface for drawing. */
  private prepareMeshes(meshes: Mesh[]): void {
    const { material, depths } = this;
    if (!material || !depths) return;
    for (const mesh of meshes) {
      mesh.material = material;
      mesh.renderOrder = 1;
      mesh.onBeforeRender = this.setDepths;
      mesh.clear();
      if (material.transparent) mesh.add(depthLayer(mesh, depths));
    }
  }

  /** Returns the visible parts of the surface, or the tiles that replace it. */
  private get shown(): Pick<Part, "geometry" | "matrix">[] {
    const tiles = this.tiles?.meshes ?? [];
    if (tiles.length) return tiles.map(({ geometry, matrixWorld }) => ({ geometry, matrix: matrixWorld }));
    return (this.loaded?.parts ?? []).filter((_, i) => this.meshes[i]?.visible);
  }

  /** Returns the names of the parts. Instances of a part share its name. */
  get partNames(): string[] {
    return [...new Set((this.loaded?.parts ?? []).map(({ name }) => name))];
  }

  /** Hides the parts with these names and shows all others, also in the following surfaces. */
  hideParts(names: Iterable<string>): void {
    this.hidden.clear();
    for (const name of names) this.hidden.add(name);
    this.meshes.forEach((mesh, i) => (mesh.visible = !this.hidden.has(this.loaded?.parts[i]?.name ?? "")));
    this.invalidate();
  }

  private release(): void {
    if (this.tiles) this.scene.remove(this.tiles.group);
    this.tiles?.dispose();
    this.tiles = null;
    for (const { geometry } of this.meshes) geometry.dispose();
    this.material?.dispose();
    this.depths?.dispose();
  }

  /** Sets the transparency of the surface: 0 is opaque, 1 is invisible. */
  setTransparency(transparency: number): void {
    this.transparency = transparency;
    this.applyTransparency();
    this.invalidate();
  }

  /** Draws the depths of a transparent surface first, so that only its nearest layer is visible. */
  private applyTransparency(): void {
    const { material, depths } = this;
    if (!material || !depths) return;
    const isTransparent = this.transparency > 0;
    material.set("alpha", 1 - this.transparency);
    if (material.transparent === isTransparent && !isTransparent) return;
    material.transparent = isTransparent;
    material.needsUpdate = true;
    this.prepareMeshes([...this.meshes, ...(this.tiles?.all ?? [])]);
  }

  /** Shows sticks with coordinates in Å, which stay when another surface is shown; null for none. */
  showSticks(geometry: BufferGeometry | null): void {
    if (!geometry && !this.sticks) return;
    if (this.sticks) {
      this.scene.remove(this.sticks.mesh);
      this.sticks.mesh.geometry.dispose();
      this.sticks.material.dispose();
      this.sticks = null;
    }
    if (geometry) {
      const material = new SurfaceMaterial(geometry);
      const mesh = new Mesh(geometry, material);
      mesh.frustumCulled = false;
      mesh.onBeforeRender = this.setDepths;
      this.sticks = { mesh, material };
      this.scene.add(mesh);
    }
    this.restyle();
  }

  /** Resolves with the time in the frame after the next one that is drawn. */
  drawn(): Promise<number> {
    this.invalidate();
    return new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(() => resolve(performance.now()))));
  }

  /** Resets the view to the whole surface from the front. */
  reset(): void {
    this.view = FRONT;
  }

  /** View of the surface; the initial one without a surface. */
  get view(): CameraView {
    return this.loaded ? viewOf(this.camera, this.controls.target, this.loaded.sphere) : FRONT;
  }

  set view(view: CameraView) {
    if (!this.loaded) return;
    place(this.camera, this.controls.target, this.loaded.sphere, view);
    this.clip();
    this.controls.update();
    this.invalidate();
  }

  /** Starts or stops the rotation. Unless `byUser`, it turns once, or not at all if reduced motion is preferred. */
  turn(on: boolean, byUser = false): void {
    this.rotation.turn(on, byUser);
    this.invalidate();
  }

  get isTurning(): boolean {
    return this.rotation.isTurning;
  }

  /** Turns by angles (radians) and zooms by a factor. Used by the keyboard. */
  move(right: number, down: number, nearer = 1): void {
    this.turn(false);
    this.view = moved(this.view, right, down, nearer);
  }

  /** Returns the atom under a point of the canvas, with (0, 0) in the middle and (1, 1) in the upper right corner. */
  pick(x: number, y: number): Hit | null {
    const { loaded } = this;
    if (!loaded) return null;
    const caster = new Raycaster();
    this.camera.updateMatrixWorld();
    caster.setFromCamera(new Vector2(x, y), this.camera);
    const { ray } = caster;
    const hits = this.shown.map(({ geometry, matrix }) => pick(geometry, matrix, ray, loaded.twoSided));
    const distance = ({ point }: Hit) => point.distanceToSquared(ray.origin);
    return hits.reduce((best, hit) => (hit && (!best || distance(hit) < distance(best)) ? hit : best), null);
  }

  /** Turns the surface of the atoms `first` to `last` to the camera. Returns false if they have none. */
  face(first: number, last: number): boolean {
    if (!this.loaded) return false;
    const parts = this.tiles ? this.shown : this.loaded.parts;
    const places = parts.map(({ geometry, matrix }) => placeOf(geometry, matrix, first, last));
    const place = places.find((found) => found !== null);
    if (!place) return false;
    this.turn(false);
    const distance = this.camera.position.distanceTo(this.controls.target);
    const direction = place.sub(this.loaded.sphere.center).normalize();
    this.camera.position.copy(this.controls.target).addScaledVector(direction, distance);
    this.controls.update();
    this.invalidate();
    return true;
  }

  /** Marks atoms by first and last row, inclusive; null marks none. */
  mark(which: "hovered" | "pinned", rows: Rows | null): void {
    if (this.style.mark(which, rows)) this.restyle();
  }

  /** Sets the colours per atom; null for the colours of the file if `usesFile`, otherwise for one colour. */
  colour(texture: DataTexture | null, atoms: number, usesFile: boolean): void {
    this.style.colour(texture, atoms, usesFile);
    if (texture) this.renderer.initTexture(texture);
    this.restyle();
  }

  /** Sets the background, and the colour of a surface without atom colours. */
  theme(background: string, plain: string): void {
    this.style.theme(background, plain);
    this.clear();
    this.restyle();
  }

  private clear(): void {
    if (!this.options.transparent) this.renderer.setClearColor(this.style.haze, 1);
  }

  /** Returns the number of triangles of all parts, or of the tiles that replace them. */
  get triangles(): number {
    return (this.tiles ? this.shown : (this.loaded?.parts ?? [])).reduce((sum, { geometry }) => sum + (geometry.getIndex()?.count ?? 0) / 3, 0);
  }

  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.size.disconnect();
    this.controls.dispose();
    this.release();
    this.showSticks(null);
    this.style.dispose();
    this.renderer.dispose();
  }

  /** Draws in the next frame. */
  invalidate(): void {
    if (!this.frame) this.frame = requestAnimationFrame((now) => this.draw(now));
  }

  private draw(now: number): void {
    this.frame = 0;
    const step = now - this.lastFrame;
    this.lastFrame = now;
    const turning = this.rotation.frame(step);
    this.sharpness.frame(step, turning);
    this.updateTiles();
    this.renderer.render(this.scene, this.camera);
    if (turning) this.invalidate();
  }

  /** Selects the tiles of the view. The surface is drawn until the first one is loaded. */
  private updateTiles(): void {
    const { tiles } = this;
    if (!tiles) return;
    this.camera.updateMatrixWorld();
    tiles.update(this.camera, this.renderer);
    const isReplaced = tiles.meshes.length > 0;
    for (const mesh of this.meshes) mesh.visible = !isReplaced;
    if (isReplaced) this.onTiles(tiles.state);
  }

  private rest(): void {
    this.lastFrame = 0;
    this.invalidate();
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.sharpness.apply();
    this.renderer.setSize(clientWidth, clientHeight, false);
    const before = Math.min(1, this.camera.aspect);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    // A narrower canvas still shows the whole surface.
    const nearer = before / Math.min(1, this.camera.aspect);
    if (nearer !== 1) this.camera.position.sub(this.controls.target).multiplyScalar(nearer).add(this.controls.target);
    this.clip();
    // A resized canvas is empty until it is drawn.
    cancelAnimationFrame(this.frame);
    this.frame = 0;
    this.renderer.render(this.scene, this.camera);
    this.invalidate();
  }

  /** Sets the near and far planes around the surface. */
  private clip(): void {
    if (this.loaded) bound(this.camera, this.controls, this.loaded.sphere.radius, this.tiles !== null);
  }

  /** Applies colours and marks to the surface, and draws it. */
  private restyle(): void {
    const { material, loaded, sticks, style } = this;
    this.invalidate();
    if (!material || !loaded) return;
    const scale = unitScale(loaded);
    style.apply(material);
    for (const each of sticks ? [material, sticks.material] : [material]) style.applyFog(each, scale);
    sticks?.mesh.scale.setScalar(1 / scale);
  }

  /** Sets the range of depths with fog, before a mesh is drawn. */
  private readonly setDepths = (): void => {
    const { center, radius } = this.loaded?.sphere ?? { center: this.controls.target, radius: 1 };
    const distance = this.camera.position.distanceTo(center);
    for (const each of [this.material, this.sticks?.material]) {
      each?.set("depths", new Vector2(distance - 0.5 * radius, distance + radius));
      if (each) each.uniformsNeedUpdate = true;
    }
  };
}
