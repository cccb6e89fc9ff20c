/** Form fields of the action cards. Input stays after the request, including after a failure. */
import { useId } from "preact/hooks";
import { format } from "../../shared/i18n/format";

interface FractionFieldProps {
  label: string;
  /** 0…1 */
  value: number;
  min: number;
  onChange: (value: number) => void;
  testid?: string;
}

/** A fraction, shown in percent. */
export function FractionField({ label, value, min, onChange, testid }: FractionFieldProps) {
  const id = useId();
  const percent = format.percent(value);
  return (
    <div class="act-share">
      <label for={id}>{label}</label>
      <input
        id={id}
        type="range"
        min={min}
        max={1}
        step={0.05}
        value={value}
        aria-valuetext={percent}
        data-testid={testid}
        onInput={(event) => onChange(event.currentTarget.valueAsNumber)}
      />
      <output for={id}>{percent}</output>
    </div>
  );
}

interface NumberFieldProps {
  label: string;
  unit: string;
  /** The typed text. */
  value: string;
  onInput: (value: string) => void;
  optional?: boolean;
  testid?: string;
}

export function NumberField({ label, unit, value, onInput, optional = false, testid }: NumberFieldProps) {
  const id = useId();
  const invalid = numberOf(value) === null && !(optional && value.trim() === "");
  return (
    <div class="act-number">
      <label for={id}>
        {label} <span class="quiet">{unit}</span>
      </label>
      <input
        id={id}
        type="text"
        inputMode="decimal"
        value={value}
        aria-invalid={invalid && value !== ""}
        data-testid={testid}
        onInput={(event) => onInput(event.currentTarget.value)}
      />
    </div>
  );
}

/** The number; `null`: empty or not finite. */
export function numberOf(typed: string): number | null {
  const value = Number(typed.trim().replace(",", ".").replace("−", "-"));
  return typed.trim() === "" || !Number.isFinite(value) ? null : value;
}

/** All numbers; `null` if one is missing. */
export function numbersOf(typed: readonly string[]): number[] | null {
  const values = typed.map(numberOf);
  return values.every((value) => value !== null) ? values : null;
}
