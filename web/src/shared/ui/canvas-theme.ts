/** The page's colours, for what is drawn on a canvas and so cannot take them from the style sheet. */

const dark = matchMedia("(prefers-color-scheme: dark)");

/** Call back when the page changes between dark and light; returns what ends it. */
export function onColourChange(callback: () => void): () => void {
  dark.addEventListener("change", callback);
  return () => dark.removeEventListener("change", callback);
}

export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Colour of the n-th line of a plot; there are eight, then they come again. */
export function seriesColour(index: number): string {
  return colour(`--series-${(index % 8) + 1}`);
}
