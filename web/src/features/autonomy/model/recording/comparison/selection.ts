/** Which session is compared, and how the times of both belong together; as in the address of the page. */

export interface Alignment {
  /** These moments are shown at the same time; each is since the start of its session [s]. */
  first_s: number;
  second_s: number;
}

export interface Selection extends Alignment {
  device: string;
  epoch: number;
}

/** Longest time in an address [ms]: a week. */
const LONGEST_MS = 604_800_000;

/** `{device},{epoch}` and, unless both starts belong together, `,{first moment},{second moment}` [ms]. */
export function selectionText({ device, epoch, first_s, second_s }: Selection): string {
  const moments = [first_s, second_s].map((seconds) => Math.min(LONGEST_MS, Math.round(Math.max(0, seconds) * 1000)));
  return [device, epoch, ...(moments.some((moment) => moment > 0) ? moments : [])].join(",");
}

/** The selection in an address; null: none, or not readable. */
export function readSelection(text: string): Selection | null {
  const [device = "", ...rest] = text.split(",");
  const numbers = rest.map((part) => (/^\d{1,15}$/.test(part) ? Number(part) : NaN));
  const [epoch = NaN, first = 0, second = 0] = numbers;
  const valid = device !== "" && epoch > 0 && (numbers.length === 1 || numbers.length === 3) && first <= LONGEST_MS && second <= LONGEST_MS;
  return valid ? { device, epoch, first_s: first / 1000, second_s: second / 1000 } : null;
}

/** Time in the second session minus the time in the first one [s]. */
export function offsetOf({ first_s, second_s }: Alignment): number {
  return second_s - first_s;
}
