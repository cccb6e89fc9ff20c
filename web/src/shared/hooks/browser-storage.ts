/** The browser's storage, if the browser permits it. */
export function storage(): Storage | null {
  try {
    return localStorage;
  } catch {
    return null;
  }
}
