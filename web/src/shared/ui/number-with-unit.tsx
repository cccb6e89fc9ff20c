interface NumberWithUnitProps {
  label: string;
  name: string;
  range: { least: number; most: number; step: number };
  value: number;
  /** The value with its unit. */
  shown: string;
  onChange: (value: number) => void;
}

export function NumberWithUnit({ label, name, range, value, shown, onChange }: NumberWithUnitProps) {
  return (
    <label class="speed">
      <span>{label}</span>
      <span class="track speed-track">
        <input
          type="range"
          data-testid={`speed-${name}`}
          min={range.least}
          max={range.most}
          step={range.step}
          value={value}
          aria-valuetext={shown}
          onInput={(event) => onChange(event.currentTarget.valueAsNumber)}
        />
      </span>
      <output>{shown}</output>
    </label>
  );
}
