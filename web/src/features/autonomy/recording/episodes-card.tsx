/** Rating, splitting, trimming and describing episodes. */
import { common } from "../../../shared/i18n/common";
import type { Episode } from "../../../shared/api/recordings";
import { Card } from "../../../shared/ui/card";
import { ConfirmButton } from "../../../shared/ui/confirm-button";
import { changed, type EpisodeList, episodeAt, rated, removed, type Replay, SHORTEST_S, split, trimmed } from "../model/recording";
import { texts } from "./texts";

const LABEL_LENGTH = 200;
const NOTE_LENGTH = 2000;

export function EpisodesCard({ replay, editable }: { replay: Replay; editable: boolean }) {
  const list = replay.episodes.list.value;
  const selected = episodeAt(list, replay.cursor.value);
  const episode = list[selected];
  return (
    <Card title={texts.episodes.title} class="session-episodes" data-testid="episodes">
      <p class="quiet small">{editable ? texts.episodes.explained : texts.episodes.readOnly}</p>
      {editable && <RatingButtons replay={replay} episode={episode} />}
      <SaveStatus replay={replay} />
      {list.length === 0 ? <p class="quiet">{texts.episodes.none}</p> : <EpisodeRows replay={replay} list={list} selected={selected} />}
      {editable && episode !== undefined && <EpisodeForm key={`${selected} ${list.length}`} replay={replay} index={selected} episode={episode} />}
    </Card>
  );
}

function RatingButtons({ replay, episode }: { replay: Replay; episode: Episode | undefined }) {
  const { episodes } = replay;
  const at = replay.cursor.value;
  const splittable = episode !== undefined && at - episode.start_s >= SHORTEST_S && episode.end_s - at >= SHORTEST_S;
  const { duration_s } = replay.timeline.value;
  return (
    <div class="row" role="group" aria-label={texts.episodes.rate}>
      {(["success", "failure"] as const).map((outcome) => (
        <button
          key={outcome}
          type="button"
          class={`session-rate outcome-${outcome}`}
          data-testid={`rate-${outcome}`}
          aria-pressed={episode?.outcome === outcome}
          onClick={() => void episodes.commit(rated(episodes.list.peek(), at, outcome, duration_s))}
        >
          {texts.episodes[outcome]}
        </button>
      ))}
      <button type="button" data-testid="split-episode" disabled={!splittable} onClick={() => void episodes.commit(split(episodes.list.peek(), at))}>
        {texts.episodes.split}
      </button>
    </div>
  );
}

function SaveStatus({ replay }: { replay: Replay }) {
  const state = replay.episodes.state.value;
  return (
    <div role="status" data-testid="episodes-state" data-state={state.kind}>
      {state.kind === "conflict" && <p class="notice warn">{texts.episodes.state.conflict}</p>}
      {state.kind === "saving" && <p class="quiet small">{texts.episodes.state.saving}</p>}
      {state.kind === "failed" && (
        <p class="notice bad row">
          <span>{texts.episodes.failed(state.reason)}</span>
          <button type="button" onClick={() => void replay.episodes.commit()}>
            {common.tryAgain}
          </button>
        </p>
      )}
    </div>
  );
}

function EpisodeRows({ replay, list, selected }: { replay: Replay; list: EpisodeList; selected: number }) {
  return (
    <ol class="session-episode-list">
      {list.map(({ start_s, end_s, outcome, label, note }, index) => (
        <li key={index} data-testid="episode" data-start={start_s} data-end={end_s} data-outcome={outcome ?? ""} aria-current={index === selected}>
          <button type="button" class="plain" onClick={() => replay.seek(start_s)}>
            {texts.episodes.name(index + 1, label)}
          </button>
          <span class="quiet small">{texts.episodes.range(start_s, end_s)}</span>
          <span class={`chip outcome-${outcome ?? "none"}`}>{texts.episodes.outcome[outcome ?? "none"]}</span>
          {note !== "" && <span class="small session-note">{note}</span>}
        </li>
      ))}
    </ol>
  );
}

function EpisodeForm({ replay, index, episode }: { replay: Replay; index: number; episode: Episode }) {
  const { episodes } = replay;
  const at = replay.cursor.value;
  const { duration_s } = replay.timeline.value;
  const save = (change: Partial<Episode>): void => void episodes.commit(changed(episodes.list.peek(), index, change));
  const trim = (end: "start_s" | "end_s"): void => void episodes.commit(trimmed(episodes.list.peek(), index, end, at, duration_s));
  return (
    <div class="panel session-form" role="group" aria-label={texts.episodes.selected(index + 1)}>
      <strong>{texts.episodes.selected(index + 1)}</strong>
      <div class="row">
        <button type="button" data-testid="start-here" disabled={at >= episode.end_s - SHORTEST_S} onClick={() => trim("start_s")}>
          {texts.episodes.startHere}
        </button>
        <button type="button" data-testid="end-here" disabled={at <= episode.start_s + SHORTEST_S} onClick={() => trim("end_s")}>
          {texts.episodes.endHere}
        </button>
        <ConfirmButton
          label={texts.episodes.remove}
          description={texts.episodes.removeOf(index + 1)}
          question={texts.episodes.removeQuestion}
          confirmLabel={texts.episodes.remove}
          busyLabel={texts.episodes.state.saving}
          cancelLabel={texts.cancel}
          onConfirm={() => episodes.commit(removed(episodes.list.peek(), index))}
          data-testid="delete-episode"
        />
      </div>
      <div class="field">
        <label for="episode-label">{texts.episodes.label}</label>
        <input
          id="episode-label"
          type="text"
          maxLength={LABEL_LENGTH}
          value={episode.label}
          onChange={(event) => save({ label: event.currentTarget.value.trim() })}
        />
      </div>
      <div class="field">
        <label for="episode-note">{texts.episodes.note}</label>
        <textarea
          id="episode-note"
          rows={2}
          maxLength={NOTE_LENGTH}
          value={episode.note}
          onChange={(event) => save({ note: event.currentTarget.value.trim() })}
        />
      </div>
    </div>
  );
}
