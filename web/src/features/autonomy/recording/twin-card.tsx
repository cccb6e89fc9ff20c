/** The robot's twin at the cursor: measured, with the requested or applied pose as a ghost. */
import { useSignalEffect } from "@preact/signals";
import { useState } from "preact/hooks";
import { format } from "../../../shared/i18n/format";
import { Card } from "../../../shared/ui/card";
import { Choice } from "../../../shared/ui/choice";
import type { DeviceStore } from "../../devices/model";
import { type LiveScene, useScene } from "../../twin";
import { type Moment, type Replay, rowOf } from "../model/recording";
import type { Comparison } from "../model/recording/comparison";
import { texts } from "./texts";

type Ghost = keyof typeof texts.twin.ghosts;
type Pose = Record<string, number>;

interface TwinCardProps {
  device: DeviceStore;
  replay: Replay;
  comparison: Comparison | null;
}

export function TwinCard({ device, replay, comparison }: TwinCardProps) {
  const [ghost, setGhost] = useState<Ghost>("requested");
  const twin = device.twin.value;
  const { canvas, box, scene, error, errorText } = useScene(twin);
  const seen = replay.showsSeen.value;
  const compared = comparison !== null && ["ready", "apart"].includes(comparison.state.value) ? comparison : null;
  return (
    <Card
      title={texts.twin.title}
      class="view session-twin"
      aside={
        <button type="button" class="plain" onClick={() => scene?.resetView()} disabled={scene === null}>
          {texts.twin.reset}
        </button>
      }
    >
      {scene !== null && <Follow scene={scene} replay={replay} comparison={compared} ghost={ghost} />}
      <div ref={box} class="canvas-box" data-testid="session-view" data-frames="0">
        {/* Keyed: a canvas cannot be drawn on after its context is lost. */}
        <canvas key={twin} ref={canvas} aria-label={texts.twin.label} role="img" />
        {twin === null && <p class="over quiet">{texts.twin.waiting}</p>}
        {error !== null && <p class="over notice">{errorText}</p>}
        <Tag replay={replay} />
      </div>
      <div class="row">
        {compared === null && <Choice label={texts.twin.ghost} value={ghost} onChange={setGhost} options={Object.entries(texts.twin.ghosts) as [Ghost, string][]} />}
        <span class="quiet small">{seen ? texts.twin.seenLegend : compared === null ? texts.twin.legend : texts.twin.comparedLegend}</span>
      </div>
    </Card>
  );
}

/** What the twin shows, if it is not the state at the cursor. */
function Tag({ replay }: { replay: Replay }) {
  const shown = replay.shown.value;
  const seen = replay.showsSeen.value ? replay.seen.value : null;
  if (shown.kind === "none") return <p class="over session-gap">{texts.noData[shown.reason]}</p>;
  return seen === null ? null : <p class="tag">{texts.twin.seenTag(format.milliseconds(seen.age_ms))}</p>;
}

function Follow({ scene, replay, comparison, ghost }: { scene: LiveScene; replay: Replay; comparison: Comparison | null; ghost: Ghost }) {
  useSignalEffect(() => {
    const measured = poseOf(replay.shown.value, "measured");
    // In a gap nothing is known: the last drawn pose is covered by the text.
    if (measured === null) return;
    const chosen = (): Pose | null => (ghost === "none" ? null : poseOf(replay.moment.value, ghost));
    const other = comparison === null ? chosen() : poseOf(comparison.moment.value, "measured");
    scene.show(measured, replay.showsSeen.value ? poseOf(replay.moment.value, "measured") : other, replay.moving.value);
  });
  return null;
}

/** Positions by joint name [rad]; null without data. The overview has no requested positions. */
function poseOf(moment: Moment, which: "measured" | "requested" | "applied"): Pose | null {
  if (moment.kind === "none" || (moment.kind === "sample" && which === "requested")) return null;
  const { samples, index } = moment;
  const columns = { measured: samples.position_rad, applied: samples.applied_rad, requested: moment.kind === "row" ? moment.samples.requested_rad : null };
  const row = columns[which] === null ? [] : rowOf(columns[which], samples.joints.length, index);
  return Object.fromEntries(samples.joints.map((name, joint) => [name, row[joint] ?? 0]));
}
