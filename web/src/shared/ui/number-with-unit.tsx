interface NumberWithUnitProps {
  label: string;
  name: string;
  range: { min: number; max: number; step: number };
  value: number;
  /** The value with its unit. */
  text: string;
  onChange: (value: number) => void;
}

export function NumberWithUnit({ label, name, range, value, text, onChange }: NumberWithUnitProps) {
  return (
    <label class="speed">
      <span>{label}</span>
      <span class="track speed-track">
        <input
          type="range"
          data-testid={`speed-${name}`}
          min={range.min}
          max={range.max}
          step={range.step}
          value={value}
          aria-valuetext={text}
          onInput={(event) => onChange(event.currentTarget.valueAsNumber)}
        />
      </span>
      <output>{text}</output>
    </label>
  );
}
