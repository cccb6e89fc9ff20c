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

it("draws the views in turn, one per frame, and limits their share of the time", async () => {
  const drawn = [0, 0, 0];
  const slots = drawn.map(
    (_, index) =>
      new DrawSlot(() => {
        drawn[index] = (drawn[index] ?? 0) + 1;
        vi.setSystemTime(Date.now() + COST_MS);
        vi.advanceTimersByTime(COST_MS);
      }),
  );
  for (let passed = 0; passed < 6_000; passed += 20) {
    for (const slot of slots) slot.request();
    await vi.advanceTimersByTimeAsync(20);
  }
  const all = drawn.reduce((sum, count) => sum + count, 0);
  expect(Math.max(...drawn) - Math.min(...drawn)).toBeLessThanOrEqual(1);
  expect(all * COST_MS).toBeLessThan(6_000 / 2);
  expect(all).toBeGreaterThan(15);
  slots.forEach((slot) => slot.dispose());
  const before = [...drawn];
  await vi.advanceTimersByTimeAsync(1_000);
  expect(drawn).toEqual(before);
});

it("draws a view that follows the pointer in each frame, at any cost", async () => {
  let drawn = 0;
  const slot = new DrawSlot(() => {
    drawn += 1;
    vi.setSystemTime(Date.now() + COST_MS);
  });
  for (let passed = 0; passed < 1_600; passed += 16) {
    slot.request(true);
    await vi.advanceTimersByTimeAsync(16);
  }
  expect(drawn).toBeGreaterThan(90);
  slot.dispose();
});
