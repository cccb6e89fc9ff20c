/** Theme colours for canvases, which cannot use the style sheet. */

const dark = matchMedia("(prefers-color-scheme: dark)");

/** Calls back when the page switches between dark and light; returns a function that unsubscribes. */
export function onColourChange(callback: () => void): () => void {
  dark.addEventListener("change", callback);
  return () => dark.removeEventListener("change", callback);
}

export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Colour of the n-th line of a plot; repeats after eight. */
export function seriesColour(index: number): string {
  return colour(`--series-${(index % 8) + 1}`);
}
