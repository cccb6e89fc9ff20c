/** The cards of a recording with a common cursor. */
import type { ComponentChildren } from "preact";
import { useEffect } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import type { DeviceStore } from "../../devices/model";
import { EpisodesCard } from "./episodes-card";
import { EventsCard } from "./events-card";
import { ImageCard } from "./image-card";
import type { Replay } from "../model/recording";
import type { Comparison } from "../model/recording/comparison";
import { PlotCard } from "./plot-card";
import { ReplayMovementCard } from "./replay-movement-card";
import { RowCard } from "./row-card";
import { TimelineCard } from "./timeline-card";
import { TwinCard } from "./twin-card";

interface ReplayViewProps {
  api: Api;
  device: DeviceStore;
  replay: Replay;
  /** Topics. */
  cameras: readonly string[];
  editable: boolean;
  comparison: Comparison | null;
  /** The card that chooses and describes the comparison. */
  children: ComponentChildren;
}

export function ReplayView({ api, device, replay, cameras, editable, comparison, children }: ReplayViewProps) {
  usePlayback(replay);
  return (
    <>
      <TimelineCard replay={replay} editable={editable} comparison={comparison} />
      <div class="session-columns">
        <TwinCard device={device} replay={replay} comparison={comparison} />
        <RowCard device={device} replay={replay} />
      </div>
      <PlotCard device={device} replay={replay} comparison={comparison} />
      {children}
      {cameras.length > 0 && (
        <div class="session-images">
          {cameras.map((topic) => (
            <ImageCard key={topic} replay={replay} topic={topic} />
          ))}
        </div>
      )}
      <div class="session-columns">
        <EpisodesCard replay={replay} editable={editable} />
        {editable && <ReplayMovementCard api={api} device={device} replay={replay} />}
        <EventsCard replay={replay} />
      </div>
    </>
  );
}

/** Advances the cursor in each animation frame while the recording plays. */
function usePlayback(replay: Replay): void {
  const playing = replay.playing.value;
  useEffect(() => {
    if (!playing) return undefined;
    let previous: number | null = null;
    let frameRequest = 0;
    const step = (time: number): void => {
      replay.tick(previous === null ? 0 : (time - previous) / 1000);
      previous = time;
      frameRequest = requestAnimationFrame(step);
    };
    frameRequest = requestAnimationFrame(step);
    return () => cancelAnimationFrame(frameRequest);
  }, [replay, playing]);
}
