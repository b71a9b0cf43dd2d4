/** State of the page, and its changes. Without DOM. */

import type { Problem } from "../client/src/problem";
import type { Source } from "./api/structures";
import { type Choices, SELECTION, type Rules } from "./rules";

/** Display of a surface apart from parameters. */
export interface Display {
  /** True if ligands are drawn as sticks. */
  readonly sticks: boolean;
  /** Transparency of the surface, per cent. */
  readonly transparency: number;
  /** Names of hidden parts. */
  readonly hidden: readonly string[];
  /** Direction, magnification and centre of the camera as text; empty for the initial ones. */
  readonly camera: string;
}

/** A surface and its display: a structure, the parameters that the user has set, and the display. */
export interface View {
  readonly source: Source;
  readonly choices: Choices;
  readonly display: Display;
}

export interface Failure {
  readonly problem: Problem;
  /** The view that was refused; null if no request for a view failed. */
  readonly view: View | null;
  /** Repeats what failed. */
  readonly again?: () => void;
}

export interface State {
  /** The view on the screen. Caption, legend, address, command line, report and downloads describe it. */
  readonly shown: View | null;
  /** The view that replaces it once everything has arrived; null if there is none. Form and menus show its values. */
  readonly wanted: View | null;
  /** The last failure. It ends with the next request and with the next view shown. */
  readonly failure: Failure | null;
}

export type Action =
  /** Asks for another structure. Without parameters and display, those of the previous structure stay if they apply. */
  | { type: "open"; source: Source; choices?: Choices; display?: Display }
  /** Sets or resets a parameter, of the refused view `base` or of the latest one. */
  | { type: "set"; name: string; value: string | undefined; base?: View | null }
  | { type: "reset" }
  | { type: "sticks"; on: boolean }
  | { type: "retry"; view: View }
  /** Changes the display without a request. */
  | { type: "adjust"; display: Partial<Omit<Display, "sticks">> }
  /** The view that `request` asked for is on the screen, with its structure in `source`. */
  | { type: "shown"; request: View; source: Source }
  | { type: "cancelled" }
  | { type: "failed"; failure: Failure }
  | { type: "dismiss" };

export const EMPTY: State = { shown: null, wanted: null, failure: null };

/** Display of a structure that no address describes. */
export const PLAIN: Display = { sticks: false, transparency: 0, hidden: [], camera: "" };

/** Returns the view whose values form and menus show. */
export const current = ({ shown, wanted }: State): View | null => wanted ?? shown;

export function reduce(state: State, action: Action, rules: Rules | null): State {
  const { shown, wanted } = state;
  const latest = current(state);
  const want = (view: View | null): State => (view ? { shown, wanted: view, failure: null } : state);
  switch (action.type) {
    case "open":
      return want(opened(latest, action));
    case "set": {
      const base = action.base ?? latest;
      return want(base && rules && { ...base, choices: rules.set(base.choices, action.name, action.value) });
    }
    case "reset":
      return want(latest && { ...latest, choices: new Map() });
    case "sticks":
      return want(latest && { ...latest, display: { ...latest.display, sticks: action.on } });
    case "retry":
      return want(action.view);
    case "adjust": {
      const { display } = action;
      const adjusted = (view: View, change: Partial<Display>) => ({ ...view, display: { ...view.display, ...change } });
      // Camera and parts of one structure say nothing about another.
      const isOther = shown !== null && wanted?.source.path !== shown.source.path;
      const shared = isOther ? (display.transparency === undefined ? {} : { transparency: display.transparency }) : display;
      return { ...state, shown: shown && adjusted(shown, display), wanted: wanted && adjusted(wanted, shared) };
    }
    case "shown": {
      const { request, source } = action;
      // The display may have been adjusted since the request.
      const isLatest = wanted?.choices === request.choices && wanted.source === request.source && wanted.display.sticks === request.display.sticks;
      const isSame = shown?.source.path === source.path;
      const { display } = isLatest ? wanted : isSame ? shown : request;
      return { shown: { ...request, source, display: { ...display, sticks: request.display.sticks } }, wanted: isLatest ? null : wanted, failure: null };
    }
    case "cancelled":
      return { shown, wanted: shown ? null : wanted, failure: null };
    case "failed":
      // Without a surface to return to, the form keeps the values, so that they can be corrected.
      return { shown, wanted: shown && action.failure.view ? null : wanted, failure: action.failure };
    case "dismiss":
      return { ...state, failure: null };
  }
}

/** Returns the view of another structure. Names of chains and the like apply to one structure only. */
function opened(previous: View | null, { source, choices, display }: Extract<Action, { type: "open" }>): View {
  const isOther = source.path === "" || source.path !== previous?.source.path;
  const shared = [...(previous?.choices ?? [])].filter(([name]) => !isOther || !SELECTION.includes(name));
  const { display: before = PLAIN } = previous ?? {};
  return {
    source,
    choices: choices ?? new Map(shared),
    display: display ?? (isOther ? { ...before, hidden: [], camera: "" } : before),
  };
}
