/** Saves a part of the recording as a movement, which a robot of the type replays. */
import { useId, useState } from "preact/hooks";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { MovementChanged } from "../../../shared/api/movement-library";
import { format } from "../../../shared/i18n/format";
import { movementAddress } from "../../../shared/routing/routes";
import { Card } from "../../../shared/ui/card";
import type { DeviceStore } from "../../devices/model";
import { appliedBetween, episodeAt, type Replay, replayScript } from "../model/recording";
import { texts } from "./texts";

const NAME = /^[A-Za-z0-9_-]{1,64}$/;

interface CardProps {
  api: Api;
  device: DeviceStore;
  replay: Replay;
}

interface Saved {
  name: string;
  message: string;
}

export function ReplayMovementCard({ api, device, replay }: CardProps) {
  const [name, setName] = useState("");
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState("");
  const [saved, setSaved] = useState<Saved | null>(null);
  const id = useId();
  const list = replay.episodes.list.value;
  const selected = episodeAt(list, replay.cursor.value);
  const episode = list[selected];
  const from_s = episode?.start_s ?? 0;
  const to_s = episode?.end_s ?? replay.timeline.value.duration_s;
  const part = episode === undefined ? texts.movement.session : texts.episodes.name(selected + 1, episode.label);
  const robotType = device.info.value.robot_type;

  const save = async (): Promise<void> => {
    setBusy(true);
    setError("");
    setSaved(null);
    try {
      const script = await scriptOf(replay, from_s, to_s, episode?.label ?? "");
      if (typeof script === "string") {
        setError(script);
        return;
      }
      await api.library.save(robotType, name, script.source, 0);
      setSaved({ name, message: texts.movement.saved(script.keyframes, format.radiansAsDegrees(script.toleranceRad)) });
    } catch (failure) {
      setError(failure instanceof MovementChanged ? texts.movement.exists : sentence(failure));
    } finally {
      setBusy(false);
    }
  };
  return (
    <Card title={texts.movement.title} class="session-reuse" data-testid="replay-movement">
      <p class="quiet small">{texts.movement.explained}</p>
      <p>{texts.movement.part(part, from_s, to_s)}</p>
      <form
        class="row"
        onSubmit={(event) => {
          event.preventDefault();
          void save();
        }}
      >
        <div class="field">
          <label for={id}>{texts.movement.name}</label>
          <input
            id={id}
            type="text"
            value={name}
            autocomplete="off"
            spellcheck={false}
            aria-describedby={`${id}-note`}
            data-testid="replay-movement-name"
            onInput={(event) => setName(event.currentTarget.value)}
          />
          <p id={`${id}-note`} class={name === "" || NAME.test(name) ? "quiet small" : "field-error"}>
            {texts.movement.nameNote}
          </p>
        </div>
        <button type="submit" disabled={busy || !NAME.test(name)} data-testid="save-replay-movement">
          {busy ? texts.movement.saving : texts.movement.save}
        </button>
      </form>
      <div role="status">
        {error !== "" && <p class="notice bad">{error}</p>}
        {saved !== null && (
          <p class="notice" data-testid="replay-movement-saved">
            {saved.message} <a href={movementAddress(robotType, saved.name)}>{texts.movement.open}</a>
          </p>
        )}
      </div>
    </Card>
  );
}

/** The script of a part, or why there is none. */
async function scriptOf(replay: Replay, from_s: number, to_s: number, label: string): Promise<{ source: string; keyframes: number; toleranceRad: number } | string> {
  const segments = await replay.segmentsBetween(from_s, to_s);
  const applied = appliedBetween(segments, from_s, to_s);
  if ("error" in applied) return texts.movement.errors[applied.error];
  const session = replay.session.value;
  const start = session?.started_at ?? null;
  const by = texts.by(session?.holder ?? null, start === null ? format.unknown : format.dateTime(start));
  const script = replayScript({ description: texts.movement.description(label, by), joints: segments[0]?.joints ?? [], samples: applied.samples });
  return "error" in script ? texts.movement.errors[script.error] : script;
}
