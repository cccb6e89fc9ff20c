/** Waits for something to become true, generously: tests depend on order, never on speed. */
export async function until(what: () => boolean, why: string, withinMs = 15_000): Promise<void> {
  const end = Date.now() + withinMs;
  while (!what()) {
    if (Date.now() > end) throw new Error(`never happened: ${why}`);
    await new Promise((resolve) => setTimeout(resolve, 5));
  }
}
