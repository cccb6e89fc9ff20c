import { afterEach, beforeEach, expect, it, vi } from "vitest";
import { DrawSlot } from "../../src/shared/hooks/draw-scheduler";

const COST_MS = 40;

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal("requestAnimationFrame", (draw: () => void) => setTimeout(draw, 16));
});

afterEach(() => {
  vi.unstubAllGlobals();
  vi.useRealTimers();
});

it("lets every view draw in its turn, one a frame, and together a quarter of the time at most", async () => {
  const drawn = [0, 0, 0];
  const turns = drawn.map(
    (_, index) =>
      new DrawSlot(() => {
        drawn[index] = (drawn[index] ?? 0) + 1;
        vi.setSystemTime(Date.now() + COST_MS);
        vi.advanceTimersByTime(COST_MS);
      }),
  );
  for (let passed = 0; passed < 6_000; passed += 20) {
    for (const turn of turns) turn.ask();
    await vi.advanceTimersByTimeAsync(20);
  }
  const all = drawn.reduce((sum, count) => sum + count, 0);
  expect(Math.max(...drawn) - Math.min(...drawn)).toBeLessThanOrEqual(1);
  expect(all * COST_MS).toBeLessThan(6_000 / 2);
  expect(all).toBeGreaterThan(15);
  turns.forEach((turn) => turn.dispose());
  const before = [...drawn];
  await vi.advanceTimersByTimeAsync(1_000);
  expect(drawn).toEqual(before);
});
