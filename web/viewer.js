// A small preview: one mesh, one light, drag to turn, wheel to zoom. WebGL 2, no dependencies.

const VERTEX = `#version 300 es
in vec3 position, normal;
uniform mat3 turn;
uniform vec4 frame; // centre, 1 / radius
uniform vec2 view; // aspect, zoom
out vec3 n;
out highp vec3 q;
void main() {
  vec3 p = turn * ((position - frame.xyz) * frame.w) * view.y;
  n = turn * normal;
  q = p;
  gl_Position = vec4(p.x / max(view.x, 1.0), p.y * min(view.x, 1.0), -p.z * 0.1, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 n;
in highp vec3 q;
uniform bool flatly; // a mesh without normals: those of its triangles
out vec4 color;
void main() {
  vec3 m = flatly ? vec3(normalize(cross(dFdx(q), dFdy(q)))) : normalize(n);
  float light = max(dot(m, normalize(vec3(0.4, 0.6, 0.8))), 0.0);
  float rim = pow(1.0 - abs(m.z), 2.0);
  color = vec4(vec3(0.16, 0.62, 0.5) * (0.3 + 0.7 * light) + 0.15 * rim, 1.0);
}`;

const TYPES = { 5120: Int8Array, 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };

/**
 * Positions, normals (if there are any) and indices of the first primitive of a GLB, without copying the buffer. Positions, `min` and `max` are in the
 * mesh's own units, whatever the node makes of them; rows may be padded.
 */
export function readGlb(buffer) {
  const head = new DataView(buffer);
  if (head.getUint32(0, true) !== 0x46546c67) throw new Error("no GLB");
  const jsonLength = head.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, jsonLength)));
  const binary = 20 + jsonLength + 8;
  const { attributes, indices } = json.meshes[0].primitives[0];
  const array = (index) => {
    const accessor = json.accessors[index];
    const view = json.bufferViews[accessor.bufferView];
    const Type = TYPES[accessor.componentType];
    const stride = view.byteStride ?? (accessor.type === "VEC3" ? 3 : 1) * Type.BYTES_PER_ELEMENT;
    if (stride * accessor.count !== view.byteLength) throw new Error("interleaved attributes");
    const data = new Type(buffer, binary + (view.byteOffset ?? 0), view.byteLength / Type.BYTES_PER_ELEMENT);
    return { data, type: accessor.componentType, normalized: accessor.normalized ?? false, stride };
  };
  const { min, max } = json.accessors[attributes.POSITION];
  const normals = attributes.NORMAL === undefined ? null : array(attributes.NORMAL);
  return { positions: array(attributes.POSITION), normals, indices: array(indices).data, min, max };
}

/** Draws a mesh into a canvas. */
export class Viewer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("the shaders do not compile");
    gl.useProgram(program);
    Object.assign(this, { canvas, gl, program, buffers: [], yaw: 0.5, pitch: 0.3, zoom: 1, count: 0, still: matchMedia("(prefers-reduced-motion: reduce)").matches, touched: false });
    canvas.addEventListener("pointerdown", (event) => { this.touched = true; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.yaw += event.movementX * 0.01;
      this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + event.movementY * 0.01));
      this.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom = Math.max(0.3, Math.min(8, this.zoom * Math.exp(-event.deltaY * 0.001)));
      this.draw();
    }, { passive: false });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show({ positions, normals, indices, min, max }) {
    const { gl, program } = this;
    this.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
    const upload = (target, data) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(target, buffer);
      gl.bufferData(target, data, gl.STATIC_DRAW);
      return buffer;
    };
    gl.uniform1i(gl.getUniformLocation(program, "flatly"), normals ? 0 : 1);
    if (!normals) gl.disableVertexAttribArray(gl.getAttribLocation(program, "normal"));
    const attributes = [["position", positions], ["normal", normals]].filter(([, rows]) => rows);
    this.buffers = attributes.map(([name, { data, type, normalized, stride }]) => {
      const buffer = upload(gl.ARRAY_BUFFER, data);
      const location = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(location);
      // glTF's numbers for types are WebGL's.
      gl.vertexAttribPointer(location, 3, type, normalized, stride, 0);
      return buffer;
    });
    this.buffers.push(upload(gl.ELEMENT_ARRAY_BUFFER, indices));
    this.count = indices.length;
    this.type = { Uint8Array: gl.UNSIGNED_BYTE, Uint16Array: gl.UNSIGNED_SHORT, Uint32Array: gl.UNSIGNED_INT }[indices.constructor.name];
    const half = max.map((value, axis) => (value - min[axis]) / 2);
    gl.uniform4f(gl.getUniformLocation(program, "frame"), ...max.map((value, axis) => (value + min[axis]) / 2), 0.95 / Math.max(Math.hypot(...half), 1e-6));
    Object.assign(this, { zoom: 1, touched: false });
    cancelAnimationFrame(this.frame);
    const spin = () => {
      if (!this.touched && !this.still) { this.yaw += 0.006; this.frame = requestAnimationFrame(spin); }
      this.draw();
    };
    spin();
  }

  draw() {
    const { canvas, gl, program } = this;
    const scale = Math.min(devicePixelRatio, 2);
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (!this.count || !width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    gl.uniformMatrix3fv(gl.getUniformLocation(program, "turn"), false, [cy, sp * sy, -cp * sy, 0, cp, sp, sy, -sp * cy, cp * cy]);
    gl.uniform2f(gl.getUniformLocation(program, "view"), width / height, this.zoom);
    gl.drawElements(gl.TRIANGLES, this.count, this.type, 0);
  }
}
