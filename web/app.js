// The page's behaviour. The form is built from /v1/capabilities, so it offers what this server takes.
import { Viewer, readGlb } from "/viewer.js";

const $ = (id) => document.getElementById(id);
const MAIN = ["preset", "resolution", "isovalue", "smoothness", "select", "format"];
const ELSEWHERE = ["report"];
const state = { file: null, name: "", capabilities: null, abort: null, url: null, viewer: null, key: "" };

/** An element with text and attributes; text is never parsed as markup. */
function element(tag, text = "", attributes = {}) {
  const node = document.createElement(tag);
  if (text) node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

/** A request to this server, with the key where one was given. */
function ask(path, options = {}) {
  const key = state.key ? { authorization: `Bearer ${state.key}` } : {};
  return fetch(path, { ...options, headers: { ...options.headers, ...key } });
}

function field(parameter) {
  const label = element("label", parameter.name.replaceAll("_", " "), { title: `${parameter.doc} Expected: ${parameter.expected}.` });
  const attributes = { name: parameter.name, id: `p-${parameter.name}` };
  let input;
  if (parameter.type === "choice" || parameter.type === "boolean") {
    input = element("select", "", attributes);
    input.append(element("option", `default: ${parameter.default}`, { value: "" }));
    for (const value of parameter.values ?? ["true", "false"]) input.append(element("option", value, { value }));
  } else {
    input = element("input", "", { ...attributes, placeholder: parameter.default, autocomplete: "off" });
    if (parameter.type === "number") input.inputMode = "decimal";
  }
  label.append(input);
  const unit = parameter.type === "number" ? `${parameter.min} to ${parameter.max} ${parameter.unit}` : (parameter.values?.join(", ") ?? "");
  if (unit && parameter.type !== "choice") label.append(element("small", unit));
  return label;
}

function query() {
  const pairs = [...new FormData($("form"))].map(([name, value]) => [name, value.trim()]).filter(([, value]) => value);
  const text = new URLSearchParams(pairs).toString();
  return text ? `?${text}` : "";
}

function showCurl() {
  const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;
  const format = $("p-format")?.value || "glb";
  const name = state.name || "4pti.pdb";
  const fetchSample = state.name ? "" : `curl -o 4pti.pdb ${location.origin}/sample.pdb\n`;
  $("curl").textContent = `${fetchSample}curl ${state.key ? '-H "X-Api-Key: $MOLMESH_KEY" ' : ""}--data-binary @${quoted(name)} -o surface.${format} ${quoted(location.origin + "/v1/meshes" + query())}`;
}

function choose(file, name) {
  state.file = file;
  state.name = name;
  $("chosen").textContent = `${name}, ${bytes(file.size)}`;
  $("run").disabled = false;
  showCurl();
}

function bytes(n) {
  const units = ["B", "kB", "MB", "GB"];
  let unit = 0;
  while (n >= 1000 && unit < units.length - 1) { n /= 1000; unit += 1; }
  return `${n.toFixed(unit ? 1 : 0)} ${units[unit]}`;
}

function fill(table, rows) {
  const body = table.querySelector("tbody");
  body.replaceChildren(...rows.map(([name, value]) => {
    const row = element("tr");
    row.append(element("th", name, { scope: "row" }), element("td", value));
    return row;
  }));
}

function showReport(headers) {
  const units = { area: " Å²", volume: " Å³", resolution: " Å" };
  const rows = [];
  for (const name of ["atoms", "vertices", "triangles", "area", "volume", "closed", "manifold", "euler", "components", "kernel", "preset", "resolution", "isovalue", "backend", "backend-reason"]) {
    const value = headers.get(`molmesh-${name}`);
    if (value === null) continue;
    const number = Number(value);
    const shown = value !== "" && Number.isFinite(number) ? number.toLocaleString("en", { maximumFractionDigits: 3 }) : value;
    rows.push([name.replace("-", " "), shown + (units[name] ?? "")]);
  }
  fill($("report"), rows);
  $("report").hidden = false;
  const times = (headers.get("server-timing") ?? "").split(", ").map((part) => part.split(";dur=")).filter((part) => part.length === 2);
  fill($("times").querySelector("table"), times.map(([stage, ms]) => [stage, `${Number(ms).toFixed(2)} ms`]));
  $("times").hidden = times.length === 0;
}

function showProblem(problem) {
  const box = $("problem");
  box.replaceChildren(element("p", problem.title), element("p", problem.detail ?? ""));
  if (problem.suggested_resolution) {
    const take = element("button", `Take ${problem.suggested_resolution} Å`, { type: "button" });
    take.addEventListener("click", () => { $("p-resolution").value = problem.suggested_resolution; $("form").requestSubmit(); });
    box.append(take);
  }
  if (problem.nearest) box.append(element("p", `Did you mean ${problem.nearest}?`));
  box.hidden = false;
}

async function preview(blob, format) {
  $("view").hidden = format !== "glb";
  if (format !== "glb") return;
  try {
    state.viewer ??= new Viewer($("view"));
    state.viewer.show(readGlb(await blob.arrayBuffer()));
  } catch (error) {
    $("view").hidden = true;
    $("status").textContent += ` No preview: ${error.message}`;
  }
}

async function run(event) {
  event.preventDefault();
  if (!state.file) return;
  const format = $("p-format").value || "glb";
  state.abort?.abort();
  const abort = state.abort = new AbortController();
  for (const id of ["problem", "report", "times", "save", "view"]) $(id).hidden = true;
  $("status").textContent = "Computing…";
  $("cancel").hidden = false;
  const start = performance.now();
  try {
    const reply = await ask(`/v1/meshes${query()}`, { method: "POST", body: state.file, signal: abort.signal, headers: { "content-type": "application/octet-stream" } });
    if (!reply.ok) {
      $("status").textContent = `Refused (${reply.status}).`;
      showProblem(await reply.json());
      return;
    }
    const blob = await reply.blob();
    $("status").textContent = `Done in ${((performance.now() - start) / 1000).toFixed(2)} s.`;
    if (state.url) URL.revokeObjectURL(state.url);
    state.url = URL.createObjectURL(blob);
    $("download").href = state.url;
    $("download").download = /filename="([^"]+)"/.exec(reply.headers.get("content-disposition") ?? "")?.[1] ?? `surface.${format}`;
    $("download").textContent = `Download ${$("download").download}`;
    $("size").textContent = bytes(blob.size);
    $("save").hidden = false;
    showReport(reply.headers);
    await preview(blob, format);
  } catch (error) {
    if (state.abort === abort) $("status").textContent = error.name === "AbortError" ? "Cancelled." : `Failed: ${error.message}`;
  } finally {
    if (state.abort === abort) $("cancel").hidden = true;
  }
}

async function start() {
  const reply = await ask("/v1/capabilities");
  $("problem").hidden = reply.ok;
  // The key stays in this page, and is gone with it.
  $("key-form").hidden = ![401, 403].includes(reply.status);
  if (!reply.ok) {
    showProblem(await reply.json());
    return;
  }
  state.capabilities = await reply.json();
  $("version").textContent = `Version ${state.capabilities.version}, ${state.capabilities.backends.map((b) => b.name).join(", ")} backend.`;
  for (const parameter of state.capabilities.parameters) {
    if (ELSEWHERE.includes(parameter.name)) continue;
    $(MAIN.includes(parameter.name) ? "main-fields" : "more-fields").append(field(parameter));
  }
  $("form").addEventListener("input", showCurl);
  $("form").addEventListener("submit", run);
  $("cancel").addEventListener("click", () => state.abort?.abort());
  $("file").addEventListener("change", () => { const [file] = $("file").files; if (file) choose(file, file.name); });
  $("sample").addEventListener("click", async () => {
    choose(await (await fetch("/sample.pdb")).blob(), "4pti.pdb");
    $("form").requestSubmit();
  });
  const drop = $("drop");
  drop.addEventListener("dragover", (event) => { event.preventDefault(); drop.classList.add("over"); });
  drop.addEventListener("dragleave", () => drop.classList.remove("over"));
  drop.addEventListener("drop", (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    const [file] = event.dataTransfer.files;
    if (file) choose(file, file.name);
  });
  showCurl();
}

function begin() {
  start().catch((error) => { $("status").textContent = `This page could not start: ${error.message}`; });
}

$("key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  state.key = $("key").value.trim();
  begin();
});
begin();
