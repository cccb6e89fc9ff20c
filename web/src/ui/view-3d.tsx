import { useSignalEffect } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import type { Control } from "../core/control";
import type { DeviceStore } from "../core/device";
import type { Targets } from "../core/streamer";
import { texts } from "../texts";
import { Card } from "./parts";
import type { LiveScene } from "./scene";
import { onColourChange } from "./theme";

interface View3DProps {
  device: DeviceStore;
  control: Control;
}

type Trouble = "no-webgl" | "failed" | null;

export function View3D({ device, control }: View3DProps) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const box = useRef<HTMLDivElement>(null);
  const [scene, setScene] = useState<LiveScene | null>(null);
  const [trouble, setTrouble] = useState<Trouble>(null);
  const twin = device.twin.value;

  useEffect(() => {
    if (twin === null) return;
    let wanted = true;
    let made: LiveScene | null = null;
    let frames = 0;
    const start = async (): Promise<void> => {
      try {
        const { createScene, NoWebglError } = await import("./scene");
        if (!wanted || canvas.current === null) return;
        try {
          made = createScene(canvas.current, twin, () => {
            frames += 1;
            box.current?.setAttribute("data-frames", String(frames));
          });
          setScene(made);
          setTrouble(null);
        } catch (error) {
          setTrouble(error instanceof NoWebglError ? "no-webgl" : "failed");
        }
      } catch {
        setTrouble("failed");
      }
    };
    void start();
    const forget = onColourChange(() => made?.recolour());
    return () => {
      wanted = false;
      forget();
      made?.dispose();
      setScene(null);
    };
  }, [twin]);

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
        data-trouble={trouble ?? ""}
      >
        {/* Keyed: a canvas whose context is gone cannot be drawn on again. */}
        <canvas key={twin} ref={canvas} aria-label={texts.view.label} role="img" />
        {twin === null && <p class="over quiet">{texts.view.waiting}</p>}
        {trouble !== null && <p class="over notice">{trouble === "no-webgl" ? texts.view.noWebgl : texts.view.failed}</p>}
        {trouble === null && scene !== null && !device.live.value && <p class="tag">{texts.view.staleNote}</p>}
      </div>
      <p class="quiet small">{texts.view.ghost}</p>
    </Card>
  );
}

/** Hands telemetry and targets to the scene, without drawing anything itself. */
function Follow({ scene, device, control }: View3DProps & { scene: LiveScene }) {
  useSignalEffect(() => {
    const message = device.telemetry.value?.message;
    const joints = device.description.value?.joints;
    if (message === undefined || joints === undefined) return;
    const measured: Record<string, number> = {};
    joints.forEach((joint, index) => (measured[joint.name] = message.position_rad[index] ?? 0));
    scene.show(measured, targets(control));
  });
  return null;
}

function targets(control: Control): Targets | null {
  const streamer = control.streamer.value;
  return streamer === null || streamer.state.value === "idle" ? null : streamer.targets.value;
}
