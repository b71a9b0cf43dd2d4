/** Control of one parameter: slider, menu, switch or text, depending on its schema. */

import type { Parameter } from "../api/schema";
import { el, number } from "./dom";
import { Scale } from "./scale";

export interface Field {
  readonly parameter: Parameter;
  readonly element: HTMLElement;
  /** The value set by the user; undefined for the default. */
  value: string | undefined;
  /** Shows the value that the service used by default. */
  effective(value: string | number | undefined): void;
  /** Sets the values that a text field offers. With values, it is a menu. */
  offer?(values: Offer[]): void;
}

/** Value with its label. */
export type Offer = [value: string, label: string];

/** Called when a value is set or reset (undefined); `live` while a slider is dragged. */
export type Changed = (name: string, value: string | undefined, live: boolean) => void;

export function field(parameter: Parameter, changed: Changed): Field {
  const { kind } = parameter;
  if (kind === "number" || kind === "integer") return numeric(parameter, changed);
  if (kind === "choice") return menu(parameter, changed);
  if (kind === "boolean") return toggle(parameter, changed);
  return text(parameter, changed);
}

const title = (parameter: Parameter) => parameter.name.replaceAll("_", " ");

/** Builds the common part of all controls: name, description and reset button. */
function frame(parameter: Parameter, changed: Changed) {
  const id = `p-${parameter.name}`;
  const reset = el("button", { type: "button", class: "reset", hidden: true, "aria-label": `Reset ${title(parameter)} to its default`, title: "Reset to default" }, "↺");
  const name = el("label", { class: "name", for: id }, title(parameter));
  const head = el("div", { class: "field-head" }, name, reset);
  const doc = el("p", { class: "doc", id: `${id}-doc` }, `${parameter.doc} Default: ${parameter.fallbackWords}.`);
  const help = el("button", { type: "button", class: "help", "aria-label": `About ${title(parameter)}`, "aria-expanded": "false", "aria-controls": `${id}-doc` }, "?");
  doc.hidden = true;
  help.addEventListener("click", () => {
    doc.hidden = !doc.hidden;
    help.setAttribute("aria-expanded", String(!doc.hidden));
  });
  name.after(help);
  const element = el("div", { class: "field", "data-parameter": parameter.name }, head, doc);
  reset.addEventListener("click", () => changed(parameter.name, undefined, false));
  const mark = (set: boolean) => {
    reset.hidden = !set;
    element.classList.toggle("is-set", set);
  };
  return { id, element, head, doc, mark };
}

function numeric(parameter: Parameter, changed: Changed): Field {
  const { id, element, head, doc, mark } = frame(parameter, changed);
  const whole = parameter.kind === "integer";
  const scale = new Scale(...parameter.usual, whole);
  const exact = el("input", { type: "number", id, class: "exact", step: "any", min: parameter.min, max: parameter.max, placeholder: parameter.fallback ?? "–", inputmode: whole ? "numeric" : "decimal" });
  const slider = el("input", { type: "range", min: 0, max: scale.steps, step: 1, "aria-label": `${title(parameter)} (slider)`, "data-slider": parameter.name });
  head.append(el("span", { class: "number" }, exact, el("span", { class: "unit", "aria-hidden": "true" }, parameter.unit)));
  doc.before(slider);
  if (parameter.unit) exact.setAttribute("aria-description", `in ${parameter.unit}`);
  let [value, shown] = [undefined as string | undefined, parameter.fallback];
  let dragging = false;
  const update = () => {
    const now = value ?? shown;
    const known = now !== undefined && now !== "" && Number.isFinite(Number(now));
    if (!dragging) slider.value = String(known ? scale.position(Number(now)) : Math.round(scale.steps / 2));
    slider.setAttribute("aria-valuetext", known ? `${number(Number(now), 3)} ${parameter.unit}`.trim() : parameter.fallbackWords);
    slider.classList.toggle("vague", !known);
    if (document.activeElement !== exact) exact.value = value ?? "";
    exact.placeholder = shown === undefined ? "–" : number(Number(shown), 3);
    mark(value !== undefined);
  };
  slider.addEventListener("pointerdown", () => (dragging = true));
  for (const end of ["pointerup", "pointercancel"]) slider.addEventListener(end, () => (dragging = false));
  slider.addEventListener("input", () => changed(parameter.name, String(scale.value(slider.valueAsNumber)), dragging));
  slider.addEventListener("change", () => {
    dragging = false;
    changed(parameter.name, String(scale.value(slider.valueAsNumber)), false);
  });
  exact.addEventListener("change", () => changed(parameter.name, exact.value.trim() === "" ? undefined : exact.value.trim(), false));
  update();
  return {
    parameter,
    element,
    get value() {
      return value;
    },
    set value(next) {
      value = next;
      if (document.activeElement === exact && exact.value !== (next ?? "")) exact.value = next ?? "";
      update();
    },
    effective(next) {
      shown = next === undefined ? parameter.fallback : String(next);
      update();
    },
  };
}

function menu(parameter: Parameter, changed: Changed): Field {
  const { id, element, head, mark } = frame(parameter, changed);
  const select = el("select", { id, "aria-describedby": `${id}-doc` });
  const named = parameter.fallback !== undefined && parameter.values.includes(parameter.fallback);
  if (!named) select.append(el("option", { value: "" }, parameter.fallbackWords === "absent" ? "off" : parameter.fallbackWords));
  for (const word of parameter.values) select.append(el("option", { value: word }, word));
  head.append(select);
  select.addEventListener("change", () => changed(parameter.name, select.value === "" || select.value === parameter.fallback ? undefined : select.value, false));
  let value: string | undefined;
  const update = () => {
    select.value = value ?? (named ? (parameter.fallback ?? "") : "");
    mark(value !== undefined);
  };
  update();
  return { parameter, element, get value() { return value; }, set value(next) { value = next; update(); }, effective: () => undefined };
}

function toggle(parameter: Parameter, changed: Changed): Field {
  const { id, element, head, mark } = frame(parameter, changed);
  const box = el("input", { type: "checkbox", id, role: "switch", "aria-describedby": `${id}-doc` });
  head.append(box);
  const standard = parameter.fallback === "true";
  box.addEventListener("change", () => changed(parameter.name, box.checked === standard ? undefined : String(box.checked), false));
  let value: string | undefined;
  const update = () => {
    box.checked = value === undefined ? standard : value === "true";
    mark(value !== undefined);
  };
  update();
  return { parameter, element, get value() { return value; }, set value(next) { value = next; update(); }, effective: () => undefined };
}

function text(parameter: Parameter, changed: Changed): Field {
  const { id, element, head, mark } = frame(parameter, changed);
  const attributes = { id, "aria-describedby": `${id}-doc` };
  const input = el("input", { type: "text", class: "wide", autocomplete: "off", spellcheck: "false", placeholder: parameter.fallbackWords, ...attributes });
  const select = el("select", attributes);
  head.append(input);
  const set = (text: string) => changed(parameter.name, text.trim() === "" ? undefined : text.trim(), false);
  input.addEventListener("change", () => set(input.value));
  select.addEventListener("change", () => set(select.value));
  let value: string | undefined;
  let offers: Offer[] = [];
  const update = () => {
    input.value = value ?? "";
    const isOther = value !== undefined && !offers.some(([offered]) => offered === value);
    const all: Offer[] = [["", parameter.fallbackWords], ...offers, ...(isOther ? [[value, value] as Offer] : [])];
    select.replaceChildren(...all.map(([offered, label]) => el("option", { value: offered }, label)));
    select.value = value ?? "";
    mark(value !== undefined);
  };
  return {
    parameter,
    element,
    get value() { return value; },
    set value(next) { value = next; update(); },
    effective(next) {
      input.placeholder = next === undefined ? parameter.fallbackWords : String(next);
    },
    offer(values) {
      offers = values;
      (values.length ? input : select).replaceWith(values.length ? select : input);
      update();
    },
  };
}
