import { format } from "../../shared/i18n/format";

export const texts = {
  spaces: {
    title: "Spaces",
    none: "No spaces.",
    devices: (count: number): string => (count === 0 ? "no devices" : format.count(count, "device")),
    of: (owner: string): string => `owned by ${owner}`,
    new: "Create a space",
    name: "Space name",
    create: "Create space",
    creating: "Creating space…",
    created: (name: string): string => `${name} was created. You can pair agents into it.`,
    failed: (reason: string): string => `The spaces failed to load: ${reason}`,
    missing: "This space does not exist, or you have no access to it.",
    empty: "This space has no devices.",
    healthOf: (name: string): string => `Health of ${name}`,
  },

  plan: {
    title: "Floor plan",
    /** Replaces a label that does not fit. */
    letter: (index: number): string => String.fromCharCode(65 + (index % 26)),
    empty: "No device in this room publishes positions. Add a room device of the kind “perception”.",
    waiting: "Waiting for data from the room…",
    label: (count: number, tracked: number): string =>
      `Floor plan with ${count === 1 ? "1 robot or person" : `${count} robots and people`}${tracked === 0 ? "" : `, ${format.count(tracked, "tracked skeleton")}`}`,
    stale: (age: string): string => `No recent data. Showing the last known state, ${age}.`,
    person: (name: string): string => (/^person(-\d+)?$/.test(name) ? name.replace("person", "Person").replace("-", " ") : name),
    seen: (age: string): string => `seen ${age}`,
    unseen: (s: number): string => `last seen ${Math.round(s)} s ago`,
    occupants: "Robots and people",
    column: { name: "Name", place: "Position (m)", heading: "Heading", seen: "Last seen" },
    sensors: "Room devices",
    place: (x: string, y: string): string => `${x}, ${y}`,
    key: { taken: "occupied", unknown: "unknown", trail: "last 30 seconds", echo: "lidar", person: "tracked person" },
    heading: (degrees: string): string => degrees,
    metre: "1 m",
  },
};
