/** The movement on the robot's twin, with the measured pose as a ghost. */
import type { DeviceStore } from "../devices/model";
import { type LiveScene, useScene } from "../twin";
import { Card } from "../../shared/ui/card";
import { useSignalEffect } from "@preact/signals";
import { useEffect } from "preact/hooks";
import type { Editor } from "./model/editor";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import type { Positions } from "./model/keyframes";
import { texts } from "./texts";

/** The measured joint positions, if current [rad]. */
export function measuredPose(device: DeviceStore): Positions | null {
  const message = device.telemetry.value?.message;
  const joints = device.description.value?.joints;
  if (message === undefined || joints === undefined || !device.live.value) return null;
  return Object.fromEntries(joints.map(({ name }, index) => [name, message.position_rad[index] ?? 0]));
}

interface TwinProps {
  twin: KnownTwin | null;
  /** The device whose measured pose is shown as a ghost; `null`: none. */
  device: DeviceStore | null;
  editor: Editor;
}

export function PreviewTwin({ twin, device, editor }: TwinProps) {
  const { canvas, box, scene, errorText } = useScene(twin);
  usePreviewClock(editor);
  const playing = editor.playing.value;
  const count = editor.movement.value.keyframes.length;
  return (
    <Card
      title={texts.twin}
      class="view kf-twin"
      aside={
        <button type="button" class="plain" onClick={() => scene?.resetView()} disabled={scene === null}>
          {texts.viewReset}
        </button>
      }
    >
      {scene !== null && <Follow scene={scene} device={device} editor={editor} />}
      <div ref={box} class="canvas-box" data-testid="kf-view" data-frames="0">
        {/* Keyed: a canvas cannot be drawn on after its context is lost. */}
        <canvas key={twin} ref={canvas} aria-label={texts.twinLabel} role="img" />
        {twin === null && <p class="over quiet">{texts.viewWaiting}</p>}
        {errorText !== "" && <p class="over notice">{errorText}</p>}
        <p class={`tag ${playing ? "kf-preview" : ""}`}>
          {playing ? texts.previewing : texts.numberOf(editor.selected.value + 1, count)}
        </p>
      </div>
      <p class="quiet small kf-legend">
        {device === null ? (
          texts.noRobot
        ) : (
          <>
            <span class="kf-swatch" aria-hidden="true" /> {device.live.value ? texts.ghost : texts.noGhost}
          </>
        )}
      </p>
    </Card>
  );
}

function Follow({ scene, device, editor }: { scene: LiveScene; device: DeviceStore | null; editor: Editor }) {
  useSignalEffect(() => scene.show(editor.pose.value, device === null ? null : measuredPose(device)));
  return null;
}

/** Advances the preview in each animation frame. */
function usePreviewClock(editor: Editor): void {
  const playing = editor.playing.value;
  useEffect(() => {
    if (!playing) return undefined;
    let previous: number | null = null;
    let frameRequest = 0;
    const step = (time: number): void => {
      editor.tick(previous === null ? 0 : (time - previous) / 1000);
      previous = time;
      frameRequest = requestAnimationFrame(step);
    };
    frameRequest = requestAnimationFrame(step);
    return () => cancelAnimationFrame(frameRequest);
  }, [editor, playing]);
}
