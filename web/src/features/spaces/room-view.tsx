import { DeviceLists, RecordedCameras } from "../devices";
import type { Fleet } from "../devices/model";
import { useEffect } from "preact/hooks";
import { texts } from "./texts";
import { FloorPlan } from "./floor-plan";

/** A room's plan and devices. */
export function RoomView({ fleet, id }: { fleet: Fleet; id: string }) {
  const all = fleet.devices.value;
  const devices = [...(all?.values() ?? [])].filter(({ info }) => info.value.space === id);
  const ids = devices.map((device) => device.id).join();
  useEffect(() => {
    const unsubscribers = devices.map((device) => device.watchMeasurements());
    return () => unsubscribers.forEach((end) => end());
    // Depends on the ids: a new list of the same devices must not subscribe again.
  }, [ids]);
  const agents = [...new Set(devices.map(({ info }) => info.value.agent))];
  // Only agents with a device position or a `positions` stream have a plan.
  const withPlan = agents.filter((agent) =>
    devices.some(({ info, description }) => {
      const received = description.value;
      if (info.value.agent !== agent || received === null) return false;
      return received.position_m !== null || received.streams.some(({ name }) => name === "positions");
    }),
  );
  return (
    <>
      <RecordedCameras devices={devices} />
      {withPlan.length === 0 && <p class="quiet">{texts.plan.empty}</p>}
      {withPlan.map((agent) => (
        <FloorPlan key={agent} fleet={fleet} space={id} agent={agent} />
      ))}
      <DeviceLists devices={devices} fleet={fleet} />
    </>
  );
}
