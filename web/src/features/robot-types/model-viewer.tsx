/** A robot type's model with a slider for the range of each joint. */
import { useScene } from "../twin";
import { Card } from "../../shared/ui/card";
import { useEffect, useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import type { Joint } from "../../shared/mqtt/protocol.generated";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface ModelViewProps {
  twin: KnownTwin;
  joints: readonly Joint[];
}

/** The permitted position nearest to zero. */
function atRest(joint: Joint): number {
  return Math.min(joint.upper_rad, Math.max(joint.lower_rad, 0));
}

export function ModelViewer({ twin, joints }: ModelViewProps) {
  const rest = Object.fromEntries(joints.map((joint) => [joint.name, atRest(joint)]));
  const [pose, setPose] = useState<Readonly<Record<string, number>>>(rest);
  const { canvas, box, scene, errorText } = useScene(twin);
  useEffect(() => scene?.show(pose, null), [scene, pose]);
  const words = texts.model;
  return (
    <Card
      title={words.title}
      class="model"
      aside={
        <span class="row">
          <button type="button" class="plain" onClick={() => setPose(rest)}>
            {words.rest}
          </button>
          <button type="button" class="plain" disabled={scene === null} onClick={() => scene?.resetView()}>
            {texts.model.reset}
          </button>
        </span>
      }
    >
      <div ref={box} class="canvas-box" data-testid="model-view" data-frames="0">
        <canvas key={twin} ref={canvas} aria-label={words.label} role="img" />
        {errorText !== "" && <p class="over notice">{errorText}</p>}
      </div>
      <p class="quiet small">{words.explained}</p>
      <ul class="model-joints" aria-label={words.joints}>
        {joints.map((joint) => (
          <JointSlider
            key={joint.name}
            joint={joint}
            at_rad={pose[joint.name] ?? 0}
            onChange={(at_rad) => setPose({ ...pose, [joint.name]: at_rad })}
          />
        ))}
      </ul>
    </Card>
  );
}

function JointSlider({ joint, at_rad, onChange }: { joint: Joint; at_rad: number; onChange: (at_rad: number) => void }) {
  const { degrees: degreesText, wholeDegrees } = format;
  const id = `model-joint-${joint.name}`;
  return (
    <li>
      <label for={id}>{joint.label}</label>
      <input
        id={id}
        data-testid={id}
        type="range"
        min={degrees(joint.lower_rad)}
        max={degrees(joint.upper_rad)}
        step="any"
        value={degrees(at_rad)}
        aria-valuetext={degreesText(degrees(at_rad))}
        onInput={(event) => onChange(radians(Number(event.currentTarget.value)))}
      />
      <output for={id}>{degreesText(degrees(at_rad))}</output>
      <span class="quiet small">{texts.range(wholeDegrees(degrees(joint.lower_rad)), wholeDegrees(degrees(joint.upper_rad)))}</span>
    </li>
  );
}
