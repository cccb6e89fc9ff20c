/** Required empty border of a QR code, in modules (ISO/IEC 18004). */
const QUIET_ZONE = 4;
const MODULE_PX = 4;

/** A QR code, drawn in the page: no other server receives its content. `rows`: `1` is black. */
export function QrCode({ rows, label }: { rows: readonly string[]; label: string }) {
  const size = rows.length + 2 * QUIET_ZONE;
  const black = rows.flatMap((row, y) =>
    Array.from(row).flatMap((module, x) => (module === "1" ? [`M${x + QUIET_ZONE} ${y + QUIET_ZONE}h1v1h-1z`] : [])),
  );
  return (
    <svg class="qr-code" width={MODULE_PX * size} viewBox={`0 0 ${size} ${size}`} role="img" aria-label={label} shape-rendering="crispEdges">
      <rect width={size} height={size} fill="#ffffff" />
      <path d={black.join("")} fill="#000000" />
    </svg>
  );
}
