import type { Control } from "../control/model";
import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useSignalEffect } from "@preact/signals";
import { texts } from "./texts";
import type { LiveScene } from "./scene";
import { useScene } from "./use-scene";

interface TwinViewProps {
  device: DeviceStore;
  control: Control;
}

export function TwinView({ device, control }: TwinViewProps) {
  const twin = device.twin.value;
  const { canvas, box, scene, error, errorText } = useScene(twin);

  return (
    <Card
      title={texts.view.title}
      class="view"
      aside={
        <button type="button" class="plain" onClick={() => scene?.resetView()} disabled={scene === null}>
          {texts.view.reset}
        </button>
      }
    >
      {scene !== null && <Follow scene={scene} device={device} control={control} />}
      <div
        ref={box}
        class={`canvas-box ${device.live.value ? "" : "old"}`}
        data-testid="view-3d"
        data-frames="0"
        data-trouble={error ?? ""}
      >
        {/* Keyed: a canvas cannot be drawn on after its context is lost. */}
        <canvas key={twin} ref={canvas} aria-label={texts.view.label} role="img" />
        {twin === null && <p class="over quiet">{texts.view.waiting}</p>}
        {error !== null && <p class="over notice">{errorText}</p>}
        {error === null && scene !== null && !device.live.value && <p class="tag">{texts.view.staleNote}</p>}
      </div>
      <p class="quiet small">{texts.view.ghost}</p>
    </Card>
  );
}

/** Passes telemetry and targets to the scene. */
function Follow({ scene, device, control }: TwinViewProps & { scene: LiveScene }) {
  useSignalEffect(() => {
    const message = device.telemetry.value?.message;
    const joints = device.description.value?.joints;
    if (message === undefined || joints === undefined) return;
    const measured: Record<string, number> = {};
    joints.forEach((joint, index) => (measured[joint.name] = message.position_rad[index] ?? 0));
    // A velocity has no target and no ghost.
    scene.show(measured, control.streamer.value?.goal.value ?? null);
  });
  return null;
}
