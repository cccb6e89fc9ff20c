/** The page of a room device: a card for each thing that it has, whatever kind of device it is. */
import { useComputed, useSignalEffect } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useMemo } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import type { Fleet } from "../devices/model/device-list";
import { Instrument } from "./model/room-device-action";
import type { KnownDescription } from "../../shared/mqtt/parse-messages";
import type { Station } from "../devices/model/device-session";
import { CameraCard } from "./camera-card";
import { DepthCard } from "./depth-card";
import { Events } from "../devices/event-log";
import { Files } from "./captures-card";
import { Gather } from "./measure-card";
import { Plan } from "../spaces/floor-plan";
import { Readings } from "./readings-card";
import { ScanCard } from "./lidar-card";
import { Settings } from "./settings-card";
import "./sensors.css";

/** What has a card of its own. */
const IMAGE = "image";
const DEPTH = "depth";
const SCAN = "scan";
const RANGE = "range";
const SETTINGS = "settings";
const POSITIONS = "positions";
const OCCUPANCY = "occupancy";

interface RoomDeskProps {
  api: Api;
  fleet: Fleet;
  station: Station;
  /** Who has access to it. */
  access: ComponentChildren;
}

export function RoomDesk({ api, fleet, station, access }: RoomDeskProps) {
  const { device, control, actions } = station;
  const instrument = useMemo(() => new Instrument(api, device, actions, () => control.epoch), [api, device, actions, control]);
  useEffect(() => void instrument.list(), [instrument]);
  // Somebody else may have captured something: the list is asked for anew whenever an action has ended.
  const action = useComputed(() => device.state.value?.action?.id ?? null);
  useSignalEffect(() => {
    if (action.value === null) void instrument.list();
  });
  const description = device.description.value;
  if (description === null) return null;
  const pictured = description.cameras.length > 0;
  const settings = description.controls.length > 0 && <Settings device={device} instrument={instrument} />;
  const has = (name: string): boolean => description.captures.includes(name);
  return (
    <div class="desk room">
      <div class="column">
        {description.cameras.map(({ name }) => (
          <CameraCard key={name} device={device} name={name} instrument={has(IMAGE) ? instrument : null} />
        ))}
        {/* Beside the picture that they change; without one they are what the page is for. */}
        {!pictured && settings}
        {has(DEPTH) && <DepthCard device={device} instrument={instrument} />}
        {(has(SCAN) || measures(description, RANGE)) && (
          <ScanCard device={device} instrument={has(SCAN) ? instrument : null} />
        )}
        {measures(description, POSITIONS) && <Plan fleet={fleet} space={device.info.value.space} agent={device.info.value.agent} />}
        {description.streams
          .filter(({ name }) => !drawnElsewhere(description, name))
          .map(({ name }) => (
            <Readings key={name} api={api} device={device} stream={name} />
          ))}
      </div>
      <div class="column">
        {pictured && settings}
        {description.actions.includes("gather") && <Gather device={device} instrument={instrument} />}
        {description.captures.length > 0 && <Files device={device} instrument={instrument} />}
        <Events device={device} />
        {access}
      </div>
    </div>
  );
}

function measures(description: KnownDescription, stream: string): boolean {
  return description.streams.some(({ name }) => name === stream);
}

function drawnElsewhere(description: KnownDescription, stream: string): boolean {
  if (stream === SETTINGS) return description.cameras.length > 0;
  return [RANGE, POSITIONS, OCCUPANCY].includes(stream);
}
