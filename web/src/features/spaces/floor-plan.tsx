/** The floor plan of a room: occupancy, robots, people and room devices. */
import type { DeviceStore, Fleet } from "../devices/model";
import { Age } from "../../shared/ui/age";
import { Card } from "../../shared/ui/card";
import { effect } from "@preact/signals";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { clock, now } from "../../shared/lib/clock";
import { separatePins, extent, readFloor, readPlaces, type Extent, type Floor, type Place } from "./model/room-perception";
import { texts } from "./texts";
import { canvasBox } from "../../shared/ui/hidpi-canvas";
import { useFloorPlanLabels } from "./floor-plan-labels";
import { deviceAddress } from "../../shared/routing/routes";
import { onColourChange } from "../../shared/ui/canvas-theme";
import "./floor-plan.css";
import { Legend, OccupantTable, MountedDeviceList } from "./floor-plan-tables";
import { paint } from "./floor-plan-canvas";
import { NOTHING_SEEN, type LiveSensors } from "./model/sightings";
import { useLiveSensors } from "./use-live-sensors";
import { useVisible } from "../../shared/hooks/use-visible";

const POSITIONS = "positions";

const OCCUPANCY = "occupancy";

export const RANGE = "range";

const TRAIL_MS = 30_000;

/** A position without an observation for this long is shown as old [s]. */
const UNSEEN_S = 2;

const PIN_PX = 24;

interface PlanProps {
  fleet: Fleet;
  space: string;
  /** The agent whose coordinate frame the plan uses: all devices of one agent share it. */
  agent: string;
}

export interface MountedDevice {
  device: DeviceStore;
  position: readonly [number, number, number];
  number: number;
}

/** The current perception of one agent. */
interface FloorPlanState {
  devices: readonly DeviceStore[];
  perception: DeviceStore | null;
  mounted: readonly MountedDevice[];
  places: readonly Place[];
  floor: Floor | null;
  /** `null` before the first data. */
  extent: Extent | null;
  old: boolean;
  receivedAt: number | null;
}

export function useFloorPlan(fleet: Fleet, space: string, agent: string): FloorPlanState {
  const all = fleet.devices.value;
  const devices = useMemo(
    () => [...(all?.values() ?? [])].filter(({ info }) => info.value.space === space && info.value.agent === agent),
    [all, space, agent],
  );
  const perception = devices.find((one) => one.description.value?.streams.some(({ name }) => name === POSITIONS)) ?? null;
  const mounted = mountedDevices(devices);
  const newest = perception?.measured(POSITIONS).value ?? null;
  const grid = perception?.measured(OCCUPANCY).value ?? null;
  const floor = useMemo(() => (grid === null ? null : readFloor(grid.message.values)), [grid]);
  const places = useMemo(() => (newest === null ? [] : readPlaces(newest.message.values)), [newest]);
  const key = mounted.map(({ position }) => position.join()).join(" ");
  const shownExtent = useMemo(
    () => extent(floor === null ? [] : [floor], [...mounted.map(({ position: [x, y] }) => [x, y] as const)]),
    [floor, key],
  );
  const old = perception?.late(POSITIONS) === true || perception?.live.value === false;
  return { devices, perception, mounted, places, floor, extent: shownExtent, old, receivedAt: newest?.receivedAt ?? null };
}

export function FloorPlan({ fleet, space, agent }: PlanProps) {
  const { devices, perception, mounted, places, floor, extent: shownExtent, old, receivedAt } = useFloorPlan(fleet, space, agent);
  const late = perception?.late(POSITIONS) === true;
  const waiting = receivedAt === null && floor === null;
  const part = useRef<HTMLDivElement>(null);
  const seen = useLiveSensors(devices, useVisible(part));
  return (
    <Card title={texts.plan.title} class="plan" aside={<Legend seen={seen} />}>
      <div class="plan-parts">
        <div ref={part} class="plan-part">
      {shownExtent === null ? (
        <p class="quiet">{perception === null ? texts.plan.empty : texts.plan.waiting}</p>
      ) : (
        <Drawing
          extent={shownExtent}
          floor={floor}
          places={places}
          mounted={mounted}
          devices={devices}
          trails={perception}
          seen={seen}
          old={old}
          receivedAt={receivedAt}
        />
      )}
      {late && receivedAt !== null && (
        <p class="notice warn" role="status">
          <Age at={receivedAt} as={texts.plan.stale} />
        </p>
      )}
      {waiting && shownExtent !== null && <p class="quiet">{perception === null ? texts.plan.empty : texts.plan.waiting}</p>}
        </div>
        <div class="plan-part">
      {places.length > 0 && <OccupantTable places={places} devices={devices} receivedAt={receivedAt ?? 0} old={late} />}
      {mounted.length > 0 && <MountedDeviceList mounted={mounted} />}
        </div>
      </div>
    </Card>
  );
}

/** Devices with a position, in list order. */
function mountedDevices(devices: readonly DeviceStore[]): MountedDevice[] {
  return devices
    .flatMap((device) => {
      const position = device.description.value?.position_m ?? null;
      return position === null ? [] : [{ device, position }];
    })
    .map((one, index) => ({ ...one, number: index + 1 }));
}

export function deviceOf(place: Place, devices: readonly DeviceStore[]): DeviceStore | null {
  return devices.find(({ info }) => info.value.name === place.name) ?? null;
}

export function nameOf(place: Place, devices: readonly DeviceStore[]): string {
  return deviceOf(place, devices)?.info.value.label ?? texts.plan.person(place.name);
}

interface DrawingProps {
  extent: Extent;
  floor: Floor | null;
  places: readonly Place[];
  mounted: readonly MountedDevice[];
  devices: readonly DeviceStore[];
  /** The device whose positions have trails. */
  trails: DeviceStore | null;
  seen?: LiveSensors;
  old: boolean;
  receivedAt: number | null;
  target?: { xM: number; yM: number; yawRad: number | null } | null;
  /** Called with the selected place; disables the links on the plan. */
  onPick?: (xM: number, yM: number) => void;
}

export type Trail = { at: number; x: number; y: number }[];

export function Drawing({ extent: room, floor, places, mounted, devices, trails, seen = NOTHING_SEEN, old, receivedAt, target, onPick }: DrawingProps) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const box = useRef<HTMLDivElement>(null);
  const [width, setWidth] = useState(0);
  const [repaint, setRepaint] = useState(0);
  const trail = useTrails(trails);
  const [widthM, heightM] = [room.highX - room.lowX, room.highY - room.lowY];
  const x = (m: number): string => `${(100 * (m - room.lowX)) / widthM}%`;
  const y = (m: number): string => `${(100 * (room.highY - m)) / heightM}%`;

  useEffect(() => onColourChange(() => setRepaint((count) => count + 1)), []);
  useEffect(() => {
    if (box.current === null) return;
    const element = box.current;
    const observer = new ResizeObserver(() => setWidth(element.clientWidth));
    observer.observe(element);
    return () => observer.disconnect();
  }, []);
  useEffect(() => {
    if (canvas.current === null) return;
    return canvasBox(canvas.current, (context, widthPx, heightPx) => paint(context, widthPx, heightPx, room, floor, trail.current, seen));
  }, [room, floor, places, seen, repaint]);

  const pins = useMemo(() => {
    if (width === 0) return [];
    const scale = width / widthM;
    const at = mounted.map(({ position: [atX, atY] }) => [(atX - room.lowX) * scale, (room.highY - atY) * scale] as const);
    const edge = PIN_PX / 2;
    const within = at.map(
      ([atX, atY]) => [Math.min(width - edge, Math.max(edge, atX)), Math.min(heightM * scale - edge, Math.max(edge, atY))] as const,
    );
    // Relative to the box, so that positions stay correct after a resize.
    return separatePins(within, PIN_PX + 1, [width, heightM * scale]).map(([atX, atY]) => [atX / width, atY / (heightM * scale)] as const);
  }, [room, width, mounted.map(({ device }) => device.id).join()]);
  const px = (share: number, of: number): number => (share * of * width) / widthM;
  useFloorPlanLabels(
    box,
    places.map(({ xM, yM }) => [px((xM - room.lowX) / widthM, widthM), px((room.highY - yM) / heightM, heightM)]),
    pins.map(([left, top]) => [px(left, widthM), px(top, heightM)]),
  );

  return (
    <div
      ref={box}
      class={`plan-box ${old ? "old" : ""}`}
      style={{ aspectRatio: `${widthM} / ${heightM}` }}
      role="group"
      aria-label={texts.plan.label(places.length, seen.people.length)}
      data-testid="plan"
      data-places={places.length}
      data-echoes={seen.echoes.length}
      data-people={seen.people.length}
      data-floor={floor === null ? "" : `${floor.columns}x${floor.rows}`}
    >
      <canvas ref={canvas} aria-hidden="true" />
      {mounted.map((one, index) => {
        const [left, top] = (pins[index] ?? [0.5, 0.5]).map((share) => `${100 * share}%`);
        return (
          <a
            key={one.device.id}
            class={`pin ${one.device.live.value ? "" : "old"}`}
            style={{ left, top }}
            href={deviceAddress(one.device.id)}
            title={one.device.info.value.label}
            aria-label={`${one.number}: ${one.device.info.value.label}`}
          >
            {one.number}
          </a>
        );
      })}
      {places.map((place, index) => (
        <Mark
          key={place.name}
          place={place}
          index={index}
          device={deviceOf(place, devices)}
          label={nameOf(place, devices)}
          left={x(place.xM)}
          top={y(place.yM)}
          receivedAt={receivedAt ?? 0}
        />
      ))}
      {target !== null && target !== undefined && (
        <span class="plan-goal" aria-hidden="true" data-testid="goal" style={{ left: x(target.xM), top: y(target.yM) }}>
          {target.yawRad !== null && <span class="arrow" style={{ transform: `rotate(${-target.yawRad}rad)` }} />}
        </span>
      )}
      {onPick !== undefined && (
        // For pointer users. Keyboard users can type the position instead.
        <div
          class="plan-pick"
          aria-hidden="true"
          data-testid="pick"
          onClick={(event) => {
            const at = event.currentTarget.getBoundingClientRect();
            onPick(
              room.lowX + ((event.clientX - at.left) / at.width) * widthM,
              room.highY - ((event.clientY - at.top) / at.height) * heightM,
            );
          }}
        />
      )}
    </div>
  );
}

interface MarkProps {
  place: Place;
  index: number;
  device: DeviceStore | null;
  label: string;
  left: string;
  top: string;
  receivedAt: number;
}

/** A disc with a direction arrow. A robot's links to its page. */
function Mark({ place, device, label, left, top, receivedAt, index }: MarkProps) {
  const ageS = place.ageS + Math.max(0, clock.value - receivedAt) / 1000;
  const unseen = ageS > UNSEEN_S;
  const content = (
    <>
      {place.yawRad !== null && <span class="arrow" style={{ transform: `rotate(${-place.yawRad}rad)` }} aria-hidden="true" />}
      <span class="occupant-leader" aria-hidden="true" />
      <span class="disc" aria-hidden="true">
        {texts.plan.letter(index)}
      </span>
      <span class="occupant-label">
        {label}
        {unseen && <span class="small"> · {texts.plan.unseen(ageS)}</span>}
      </span>
    </>
  );
  const common = {
    class: `occupant ${device === null ? "human" : "robot"} series-${(index % 8) + 1} ${unseen ? "old" : ""}`,
    style: { left, top },
    "data-testid": `place-${place.name}`,
    "data-x": place.xM,
    "data-y": place.yM,
  };
  if (device === null) return <span {...common}>{content}</span>;
  return (
    <a {...common} href={deviceAddress(device.id)}>
      {content}
    </a>
  );
}

/** Positions of robots and people in the last 30 s, on the page's clock. */
function useTrails(perception: DeviceStore | null): { readonly current: ReadonlyMap<string, Trail> } {
  const trails = useRef(new Map<string, Trail>());
  useEffect(() => {
    trails.current = new Map();
    if (perception === null) return;
    return effect(() => {
      const newest = perception.measured(POSITIONS).value;
      if (newest === null) return;
      for (const { name, xM, yM } of readPlaces(newest.message.values)) {
        const since = now() - TRAIL_MS;
        const trail = (trails.current.get(name) ?? []).filter(({ at }) => at > since);
        trails.current.set(name, [...trail, { at: newest.receivedAt, x: xM, y: yM }]);
      }
    });
  }, [perception]);
  return trails;
}
