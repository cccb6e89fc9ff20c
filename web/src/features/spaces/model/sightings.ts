/** What the live sensors of a room saw last, by stream. */
import { Arrivals, lateAfterMs } from "../../../shared/lib/arrivals";
import type { KnownPerson } from "../../../shared/mqtt/sensor-frames";

/** What sensors see now. */
export interface LiveSensors {
  /** Places where beams ended [m]. */
  echoes: readonly (readonly [number, number])[];
  people: readonly KnownPerson[];
}

export const NOTHING_SEEN: LiveSensors = { echoes: [], people: [] };

export interface Sighting extends LiveSensors {
  /** Arrival on the page's clock [ms]. */
  at: number;
  /** The age from which it is not drawn [ms]. */
  lateAfterMs: number;
}

/** Adds the age limit to the sightings of one stream. */
export class SightingTimer {
  readonly #rateHz: number;
  readonly #arrivals = new Arrivals();

  /** `rateHz`: the declared rate. */
  constructor(rateHz: number) {
    this.#rateHz = rateHz;
  }

  /** A sighting that arrives at `at` [ms]. */
  arrived(seen: Partial<LiveSensors>, at: number): Sighting {
    this.#arrivals.add(at);
    return { ...NOTHING_SEEN, ...seen, at, lateAfterMs: lateAfterMs(this.#rateHz, this.#arrivals.everyMs) };
  }
}

/** Those that are not late. */
export function currentSightings(sightings: Iterable<Sighting>, atMs: number): Sighting[] {
  return [...sightings].filter((one) => atMs - one.at <= one.lateAfterMs);
}
