/** The page of a device without joints: one card for each capability in its description. */
import { ActionCards } from "../../features/actions";
import { CameraConsentCard, EventLog } from "../../features/devices";
import type { DeviceSession } from "../../features/control/model";
import type { Fleet } from "../../features/devices/model";
import { FloorPlan } from "../../features/spaces";
import { useComputed, useSignalEffect } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useMemo } from "preact/hooks";
import type { Api } from "../../shared/api/client";
import { CameraCard, CapturesCard, CollectDataCard, DepthCard, LidarCard, ReadingsCard, SettingsCard } from "../../features/sensors";
import { RoomDeviceAction } from "../../features/sensors/model";
import type { KnownDescription } from "../../shared/mqtt/parse-messages";

/** A capture with its own card. */
const IMAGE = "image";
const DEPTH = "depth";
const SCAN = "scan";
const PEOPLE = "people";
const RANGE = "range";
const SETTINGS = "settings";
const POSITIONS = "positions";
const OCCUPANCY = "occupancy";

interface RoomDevicePageProps {
  api: Api;
  fleet: Fleet;
  session: DeviceSession;
  /** The access list. */
  access: ComponentChildren;
}

export function RoomDevicePage({ api, fleet, session, access }: RoomDevicePageProps) {
  const { device, control, actions } = session;
  const roomAction = useMemo(() => new RoomDeviceAction(api, device, actions, () => control.epoch), [api, device, actions, control]);
  useEffect(() => void roomAction.list(), [roomAction]);
  // Another user may have captured files: reload the list after every action.
  const action = useComputed(() => device.state.value?.action?.id ?? null);
  useSignalEffect(() => {
    if (action.value === null) void roomAction.list();
  });
  const description = device.description.value;
  if (description === null) return null;
  const colour = description.cameras.filter(({ kind }) => kind === "colour");
  const hasCamera = colour.length > 0;
  const settings = description.controls.length > 0 && <SettingsCard device={device} roomAction={roomAction} />;
  const has = (name: string): boolean => description.captures.includes(name);
  return (
    <div class="desk room">
      <div class="column">
        {colour.map(({ name }) => (
          <CameraCard key={name} device={device} name={name} roomAction={has(IMAGE) ? roomAction : null} />
        ))}
        {/* Without a camera, settings are the main content; otherwise they are in the second column. */}
        {!hasCamera && settings}
        {(has(DEPTH) || streams(description, DEPTH) || streams(description, PEOPLE)) && (
          <DepthCard device={device} roomAction={has(DEPTH) ? roomAction : null} />
        )}
        {(has(SCAN) || streams(description, SCAN) || measures(description, RANGE)) && (
          <LidarCard device={device} roomAction={has(SCAN) ? roomAction : null} />
        )}
        {measures(description, POSITIONS) && <FloorPlan fleet={fleet} space={device.info.value.space} agent={device.info.value.agent} />}
        {description.streams
          .filter(({ name }) => !hasOwnCard(description, name))
          .map(({ name }) => (
            <ReadingsCard key={name} api={api} device={device} stream={name} />
          ))}
      </div>
      <div class="column">
        {hasCamera && settings}
        <ActionCards fleet={fleet} session={session} />
        {description.actions.includes("gather") && <CollectDataCard device={device} roomAction={roomAction} />}
        {description.captures.length > 0 && <CapturesCard device={device} roomAction={roomAction} />}
        <CameraConsentCard api={api} device={device} />
        <EventLog device={device} />
        {access}
      </div>
    </div>
  );
}

function measures(description: KnownDescription, stream: string): boolean {
  return description.streams.some(({ name }) => name === stream);
}

/** Whether the device streams frames of this kind. */
function streams(description: KnownDescription, kind: string): boolean {
  return description.cameras.some((camera) => camera.kind === kind);
}

function hasOwnCard(description: KnownDescription, stream: string): boolean {
  if (stream === SETTINGS) return streams(description, "colour");
  return [RANGE, POSITIONS, OCCUPANCY].includes(stream);
}
