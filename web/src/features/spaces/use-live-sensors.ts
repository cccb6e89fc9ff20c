/** Live lidar scans and tracked people of a room, for the floor plan. */
import type { DeviceStore } from "../devices/model";
import { useEffect, useMemo, useState } from "preact/hooks";
import { clock, now } from "../../shared/lib/clock";
import { echoesOf } from "../../shared/lib/skeleton";
import { readPeople, readScan } from "../../shared/mqtt/sensor-frames";
import { currentSightings, type LiveSensors, type Sighting, SightingTimer } from "./model/sightings";

/** Subscribes to the scans and people of all devices while `active`. */
export function useLiveSensors(devices: readonly DeviceStore[], active: boolean): LiveSensors {
  const [seen, setSeen] = useState<ReadonlyMap<string, Sighting>>(new Map());
  const streams = devices.flatMap((device) =>
    (device.description.value?.cameras ?? []).flatMap(({ name, kind, rate_hz: rateHz }) =>
      kind === "scan" || kind === "people" ? [{ device, name, kind, rateHz } as const] : [],
    ),
  );
  const key = streams.map(({ device, name, rateHz }) => `${device.id}/${name}@${rateHz}`).join(" ");
  useEffect(() => {
    if (!active) return;
    const ends = streams.map(({ device, name, kind, rateHz }) => {
      const timer = new SightingTimer(rateHz);
      return device.watchFrames(name, kind, ({ content }) => {
        const found = kind === "scan" ? { echoes: echoesOf(readScan(content)) } : { people: readPeople(content).people };
        const sighting = timer.arrived(found, now());
        setSeen((previous) => new Map(previous).set(`${device.id}/${name}`, sighting));
      });
    });
    return () => {
      for (const end of ends) end();
      setSeen(new Map());
    };
    // Depends on the names and rates: new objects of the same streams must not subscribe again.
  }, [key, active]);
  const present = currentSightings(seen.values(), clock.value);
  const state = present.map(({ at }) => at).join();
  return useMemo(() => ({ echoes: present.flatMap(({ echoes }) => echoes), people: present.flatMap(({ people }) => people) }), [seen, state]);
}
