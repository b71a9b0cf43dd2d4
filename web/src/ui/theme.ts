/** Light or dark colours: the system setting, or the choice of the user. */

import { $ } from "./dom";

type Choice = "system" | "light" | "dark";
const KEY = "molmesh-theme";
const NEXT: Record<Choice, Choice> = { system: "light", light: "dark", dark: "system" };
const LABELS: Record<Choice, [string, string]> = { system: ["◐", "system setting"], light: ["☀", "light"], dark: ["☾", "dark"] };

/** Applies the choice. Calls `changed` now and whenever colours change. */
export function theme(changed: () => void): void {
  const button = $("theme");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let choice = stored();
  const apply = () => {
    const isDark = choice === "dark" || (choice === "system" && dark.matches);
    document.documentElement.dataset["theme"] = isDark ? "dark" : "light";
    const [sign, words] = LABELS[choice];
    button.textContent = sign;
    button.setAttribute("aria-label", `Colours: ${words}`);
    button.title = `Colours: ${words}`;
    changed();
  };
  button.addEventListener("click", () => {
    choice = NEXT[choice];
    try {
      localStorage.setItem(KEY, choice);
    } catch {
      // Without storage, the choice lasts until the page is closed.
    }
    apply();
  });
  dark.addEventListener("change", apply);
  apply();
}

function stored(): Choice {
  try {
    const found = localStorage.getItem(KEY);
    return found === "light" || found === "dark" ? found : "system";
  } catch {
    return "system";
  }
}

/** Returns a colour of the style sheet. */
export function color(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
