/** Chooses the moments of two sessions that are shown at the same time: starts, episodes or any times. */
import type { Replay } from "../../model/recording";
import type { Alignment, Comparison } from "../../model/recording/comparison";
import { texts as sessionTexts } from "../texts";
import { texts } from "./texts";

interface AlignFormProps {
  comparison: Comparison;
  onAlign: (alignment: Alignment) => void;
}

export function AlignForm({ comparison, onAlign }: AlignFormProps) {
  const alignment = comparison.alignment.value;
  return (
    <fieldset class="session-align">
      <legend>{texts.align}</legend>
      <MomentField which="first" replay={comparison.first} value={alignment.first_s} onChange={(first_s) => onAlign({ ...alignment, first_s })} />
      <button type="button" class="plain" data-testid="align-cursor" onClick={() => onAlign({ ...alignment, first_s: comparison.first.cursor.peek() })}>
        {texts.cursor}
      </button>
      <MomentField which="second" replay={comparison.second} value={alignment.second_s} onChange={(second_s) => onAlign({ ...alignment, second_s })} />
    </fieldset>
  );
}

interface MomentFieldProps {
  which: "first" | "second";
  replay: Replay;
  /** [s] */
  value: number;
  onChange: (seconds: number) => void;
}

/** A moment of one session: its start, the start of an episode, or a time. */
function MomentField({ which, replay, value, onChange }: MomentFieldProps) {
  const moments = [
    { name: texts.start, at_s: 0 },
    ...replay.episodes.list.value.map(({ label, start_s }, index) => ({ name: sessionTexts.episodes.name(index + 1, label), at_s: start_s })),
  ];
  const chosen = moments.findIndex(({ at_s }) => Math.abs(at_s - value) < 0.001);
  const change = (text: string): void => {
    const seconds = Number(text);
    if (Number.isFinite(seconds) && seconds >= 0) onChange(seconds);
  };
  return (
    <span class="row">
      <label>
        {texts.event[which]}
        <select data-testid={`align-${which}`} value={String(chosen)} onChange={(event) => onChange(moments[Number(event.currentTarget.value)]?.at_s ?? value)}>
          {moments.map(({ name }, index) => (
            <option key={index} value={String(index)}>
              {name}
            </option>
          ))}
          {chosen < 0 && <option value="-1">{texts.other}</option>}
        </select>
      </label>
      <label>
        {texts.moment[which]}
        <input type="number" min={0} step={0.1} data-testid={`align-${which}-s`} value={value.toFixed(1)} onChange={(event) => change(event.currentTarget.value)} />
      </label>
    </span>
  );
}
