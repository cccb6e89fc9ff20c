/** Selects a duration: a preset or an end date. */
import { common } from "../i18n/common";

const LENGTHS = { hour: 3600, workday: 8 * 3600, day: 86_400, week: 7 * 86_400, month: 30 * 86_400 } as const;

interface DurationChoice {
  choice: keyof typeof LENGTHS | "never" | "date" | "keep";
  /** Value of a date input, in local time. */
  date: string;
}

export const NO_EXPIRY: DurationChoice = { choice: "never", date: "" };
export const UNCHANGED: DurationChoice = { choice: "keep", date: "" };
export const ONE_DAY: DurationChoice = { choice: "day", date: "" };

/** Duration in seconds from now; `null`: no end, `undefined`: invalid. `remainingS`: the previous remaining time. */
export function seconds({ choice, date }: DurationChoice, remainingS: number | null = null): number | null | undefined {
  if (choice === "never") return null;
  if (choice === "keep") return remainingS;
  if (choice !== "date") return LENGTHS[choice];
  const left = Math.floor((new Date(date).getTime() - Date.now()) / 1000);
  return left >= 60 ? left : undefined; // `left` is NaN without a date.
}

interface DurationPickerProps {
  id: string;
  label: string;
  value: DurationChoice;
  choices: readonly DurationChoice["choice"][];
  onChange: (value: DurationChoice) => void;
}

export function DurationPicker({ id, label, value, choices, onChange }: DurationPickerProps) {
  return (
    <div class="field">
      <label for={id}>{label}</label>
      <div class="row">
        <select
          id={id}
          value={value.choice}
          onChange={(event) => {
            const choice = choices.find((each) => each === event.currentTarget.value);
            if (choice !== undefined) onChange({ ...value, choice });
          }}
        >
          {choices.map((choice) => (
            <option key={choice} value={choice}>
              {common.duration[choice]}
            </option>
          ))}
        </select>
        {value.choice === "date" && (
          <input
            type="datetime-local"
            aria-label={common.duration.pick}
            required
            value={value.date}
            onInput={(event) => onChange({ ...value, date: event.currentTarget.value })}
          />
        )}
      </div>
    </div>
  );
}
