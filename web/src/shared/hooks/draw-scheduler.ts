/**
 * Draws expensive views in the order of their requests. Each frame draws at least one view and stays within a time budget, so that sliders
 * and setpoints keep priority.
 */
import { now } from "../lib/clock";

/** Drawing uses at most this fraction (1/n) of the page's time. */
const TIME_SHARE = 4;
const LONGEST_WAIT_MS = 400;
/** Frames below this cost are not noticeable [ms]. */
const FREE_MS = 6;

/** Slots waiting to draw, in the order of their requests. */
const queue = new Set<DrawSlot>();
let scheduled = false;

export class DrawSlot {
  readonly #draw: () => void;

  /** `draw`: called in an animation frame. */
  constructor(draw: () => void) {
    this.#draw = draw;
  }

  /** Requests a redraw in one of the next frames. */
  request(): void {
    queue.add(this);
    next();
  }

  dispose(): void {
    queue.delete(this);
  }

  static next(): void {
    const [slot] = queue;
    if (slot === undefined) return;
    queue.delete(slot);
    slot.#draw();
  }
}

function next(): void {
  if (scheduled || queue.size === 0) return;
  scheduled = true;
  requestAnimationFrame(() => {
    const startedAt = now();
    do DrawSlot.next();
    while (queue.size > 0 && now() - startedAt < FREE_MS / 2);
    // Without a GPU a frame can exceed its budget; then the next one is delayed.
    setTimeout(() => {
      const tookMs = now() - startedAt;
      setTimeout(
        () => {
          scheduled = false;
          next();
        },
        Math.min((TIME_SHARE - 1) * Math.max(0, tookMs - FREE_MS), LONGEST_WAIT_MS),
      );
    }, 0);
  });
}
