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
  reset.addEventListener("click", () => set(undefined));
  const set = (value: string | undefined, live = false) => changed(parameter.name, value, live);
  /** Returns the field. `update` shows its value in the control. */
  const create = (update: (value: string | undefined) => void, effective: Field["effective"] = () => undefined, offer?: Field["offer"]): Field => {
    let value: string | undefined;
    update(value);
    return {
      parameter,
      element,
      get value() { return value; },
      set value(next) {
        value = next;
        update(value);
        reset.hidden = value === undefined;
        element.classList.toggle("is-set", value !== undefined);
      },
      effective,
      ...(offer && { offer }),
    };
  };
  return { id, head, doc, set, create };
}

function numeric(parameter: Parameter, changed: Changed): Field {
  const { id, head, doc, set, create } = frame(parameter, changed);
  const whole = parameter.kind === "integer";
  const scale = new Scale(...parameter.usual, whole);
  const exact = el("input", { type: "number", id, class: "exact", step: "any", min: parameter.min, max: parameter.max, placeholder: parameter.fallback ?? "–", inputmode: whole ? "numeric" : "decimal" });
  const slider = el("input", { type: "range", min: 0, max: scale.steps, step: 1, "aria-label": `${title(parameter)} (slider)`, "data-slider": parameter.name });
  head.append(el("span", { class: "number" }, exact, el("span", { class: "unit", "aria-hidden": "true" }, parameter.unit)));
  doc.before(slider);
  if (parameter.unit) exact.setAttribute("aria-description", `in ${parameter.unit}`);
  let [current, shown] = [undefined as string | undefined, parameter.fallback];
  let dragging = false;
  const update = (value: string | undefined) => {
    // The user may be typing.
    if (document.activeElement !== exact || value !== current) exact.value = value ?? "";
    current = value;
    const now = value ?? shown;
    const known = now !== undefined && now !== "" && Number.isFinite(Number(now));
    if (!dragging) slider.value = String(known ? scale.position(Number(now)) : Math.round(scale.steps / 2));
    slider.setAttribute("aria-valuetext", known ? `${number(Number(now), 3)} ${parameter.unit}`.trim() : parameter.fallbackWords);
    slider.classList.toggle("vague", !known);
    exact.placeholder = shown === undefined ? "–" : number(Number(shown), 3);
  };
  const slid = (live: boolean) => set(String(scale.value(slider.valueAsNumber)), live);
  slider.addEventListener("pointerdown", () => (dragging = true));
  for (const end of ["pointerup", "pointercancel"]) slider.addEventListener(end, () => (dragging = false));
  slider.addEventListener("input", () => slid(dragging));
  slider.addEventListener("change", () => {
    dragging = false;
    slid(false);
  });
  exact.addEventListener("change", () => set(exact.value.trim() || undefined));
  return create(update, (next) => {
    shown = next === undefined ? parameter.fallback : String(next);
    update(current);
  });
}

function menu(parameter: Parameter, changed: Changed): Field {
  const { id, head, set, create } = frame(parameter, changed);
  const select = el("select", { id, "aria-describedby": `${id}-doc` });
  const named = parameter.fallback !== undefined && parameter.values.includes(parameter.fallback);
  if (!named) select.append(el("option", { value: "" }, parameter.fallbackWords === "absent" ? "off" : parameter.fallbackWords));
  for (const word of parameter.values) select.append(el("option", { value: word }, word));
  head.append(select);
  select.addEventListener("change", () => set(select.value === "" || select.value === parameter.fallback ? undefined : select.value));
  return create((value) => (select.value = value ?? (named ? (parameter.fallback ?? "") : "")));
}

function toggle(parameter: Parameter, changed: Changed): Field {
  const { id, head, set, create } = frame(parameter, changed);
  const box = el("input", { type: "checkbox", id, role: "switch", "aria-describedby": `${id}-doc` });
  head.append(box);
  const standard = parameter.fallback === "true";
  box.addEventListener("change", () => set(box.checked === standard ? undefined : String(box.checked)));
  return create((value) => (box.checked = value === undefined ? standard : value === "true"));
}

function text(parameter: Parameter, changed: Changed): Field {
  const { id, head, set, create } = frame(parameter, changed);
  const attributes = { id, "aria-describedby": `${id}-doc` };
  const input = el("input", { type: "text", class: "wide", autocomplete: "off", spellcheck: "false", placeholder: parameter.fallbackWords, ...attributes });
  const select = el("select", attributes);
  head.append(input);
  for (const control of [input, select]) control.addEventListener("change", () => set(control.value.trim() || undefined));
  let current: string | undefined;
  let offers: Offer[] = [];
  const update = (value: string | undefined) => {
    current = value;
    input.value = value ?? "";
    const isOther = value !== undefined && !offers.some(([offered]) => offered === value);
    const all: Offer[] = [["", parameter.fallbackWords], ...offers, ...(isOther ? [[value, value] as Offer] : [])];
    select.replaceChildren(...all.map(([offered, label]) => el("option", { value: offered }, label)));
    select.value = value ?? "";
  };
  const effective: Field["effective"] = (next) => (input.placeholder = next === undefined ? parameter.fallbackWords : String(next));
  return create(update, effective, (values) => {
    offers = values;
    (values.length ? input : select).replaceWith(values.length ? select : input);
    update(current);
  });
}
