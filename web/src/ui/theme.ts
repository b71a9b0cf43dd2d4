/** Light and dark: as the system has it, until the button says otherwise. */

import { $ } from "./dom";

type Choice = "system" | "light" | "dark";
const KEY = "molmesh-theme";
const NEXT: Record<Choice, Choice> = { system: "light", light: "dark", dark: "system" };
const SAID: Record<Choice, [string, string]> = { system: ["◐", "as the system has them"], light: ["☀", "light"], dark: ["☾", "dark"] };

/** Applies the choice; `changed` is told whenever colours change, and once now. */
export function theme(changed: () => void): void {
  const button = $("theme");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let choice = kept();
  const apply = () => {
    const isDark = choice === "dark" || (choice === "system" && dark.matches);
    document.documentElement.dataset["theme"] = isDark ? "dark" : "light";
    const [sign, words] = SAID[choice];
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
      // Without storage the choice lasts as long as the page.
    }
    apply();
  });
  dark.addEventListener("change", apply);
  apply();
}

function kept(): Choice {
  try {
    const found = localStorage.getItem(KEY);
    return found === "light" || found === "dark" ? found : "system";
  } catch {
    return "system";
  }
}

/** A colour of the style sheet. */
export function color(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
