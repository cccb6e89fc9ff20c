/** Camera views of a robot: its own cameras and those of its room. */
import type { DeviceStore, Fleet } from "../devices/model";
import { useEffect, useState } from "preact/hooks";
import { texts } from "./texts";
import { CameraCard } from "./camera-card";

interface View {
  key: string;
  device: DeviceStore;
  camera: string;
}

interface CameraSwitcherProps {
  device: DeviceStore;
  views: readonly View[];
}

/** The robot's own cameras first, then those of its space. */
export function useCameraSources(fleet: Fleet, device: DeviceStore): readonly View[] {
  const all = fleet.devices.value;
  const space = device.info.value.space;
  const others = [...(all?.values() ?? [])].filter(({ id, info }) => id !== device.id && info.value.space === space);
  const ids = others.map(({ id }) => id).join();
  useEffect(() => {
    const unsubscribers = others.map((one) => one.watchDescription());
    return () => unsubscribers.forEach((end) => end());
  }, [ids]);
  return [device, ...others].flatMap((one) =>
    (one.description.value?.cameras ?? [])
      .filter(({ kind }) => kind === "colour")
      .map(({ name }) => ({ key: `${one.id}/${name}`, device: one, camera: name })),
  );
}

export function CameraSwitcher({ device, views }: CameraSwitcherProps) {
  const [selected, setSelected] = useState("");
  const view = views.find(({ key }) => key === selected) ?? views[0];
  if (view === undefined) return null;
  const name = ({ device: of, camera }: View): string =>
    of === device ? texts.cameraSource.own(camera) : texts.cameraSource.from(of.info.value.label, camera);
  const choice = views.length > 1 && (
    <select
      aria-label={texts.cameraSource.choose}
      data-testid="watch-from"
      value={view.key}
      onChange={(event) => setSelected(event.currentTarget.value)}
    >
      {views.map((one) => (
        <option key={one.key} value={one.key}>
          {name(one)}
        </option>
      ))}
    </select>
  );
  return (
    <CameraCard key={view.key} device={view.device} name={view.camera} roomAction={null} title={texts.cameraSource.title} aside={choice} />
  );
}
