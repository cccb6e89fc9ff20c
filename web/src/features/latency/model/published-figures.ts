/** Response times published in the papers, for comparison. */
import type { Path } from "../../../shared/api/latency";

export interface Published {
  id: string;
  ms: number;
  /** The comparable paths. */
  paths: readonly Path[];
  source: "ur5" | "telescope";
}

export const SOURCES = {
  ur5: {
    short: "UR5 over XMPP, Table 2",
    citation:
      "R. A. Atmoko, D. Yang, M. I. Abas, A. Z. Arfianto, R. Rahim: Teleoperation Cloud Industrial Robot using XMPP Protocol. " +
      "Table 2, latency of a message from its sender through a server in Singapore to its receiver; 20 of the samples, and their average.",
  },
  telescope: {
    short: "Telescope v2, section 4",
    citation:
      "Telescope v2 (Technical University of Košice), section 4. Fig. 5: from the operator's request to the moment when the robot began to act " +
      "(NAO, Qbo, Hanson; averages without unusual measurements). Fig. 6: a room client's request to the cloud until its response, in a network of about 15 ms.",
  },
} as const;

/** Table 2 of the UR5 paper, in its order [ms]. */
export const UR5_TABLE_2 = {
  http: [2762, 3244, 2711, 2859, 3235, 2817, 2935, 2962, 2857, 2999, 3298, 2931, 3286, 3115, 2776, 2783, 3214, 3032, 3142, 2934],
  xmpp: [800, 855, 890, 815, 854, 761, 800, 894, 809, 802, 879, 821, 820, 782, 795, 894, 842, 808, 759, 805],
} as const;

const MESSAGE: readonly Path[] = ["operator-device", "command-answered"];
const REACTION: readonly Path[] = ["operator-device", "command-started"];
const CLIENT: readonly Path[] = ["operator-cloud", "device-cloud", "operator-device"];

/** Averages, and the minimum and maximum where a paper states them. */
export const PUBLISHED: readonly Published[] = [
  { id: "ur5-http", ms: 2994.6, paths: MESSAGE, source: "ur5" },
  { id: "ur5-xmpp", ms: 824.25, paths: MESSAGE, source: "ur5" },
  { id: "telescope-slowest", ms: 259, paths: REACTION, source: "telescope" },
  { id: "telescope-fastest", ms: 86, paths: REACTION, source: "telescope" },
  { id: "telescope-client-worst", ms: 103, paths: CLIENT, source: "telescope" },
  { id: "telescope-client", ms: 63, paths: CLIENT, source: "telescope" },
  { id: "telescope-client-best", ms: 36, paths: CLIENT, source: "telescope" },
];

/** The figures that are comparable with a path, or all. */
export function publishedFor(path: Path | null): readonly Published[] {
  return path === null ? PUBLISHED : PUBLISHED.filter(({ paths }) => paths.includes(path));
}
