const MISSING = "–";
const MINUS = "−";

/** Write a metric's value as the tables of `vislam compare` do: three significant digits, its whole part in full. */
function cellText(value, column) {
  const scaled = value * column.shown_in.factor;
  const size = Math.abs(scaled);
  if (size === 0 || (column.count && size < 1e9)) return scaled.toFixed(0).replace("-", MINUS);
  if (size < 1e-3 || size >= 1e5) return scaled.toExponential(size < 1 ? 1 : 0).replaceAll("-", MINUS).replace("e+", "e");
  const exponent = Math.floor(Math.log10(Number(size.toPrecision(3))));
  return scaled.toFixed(Math.max(0, 2 - exponent)).replace("-", MINUS);
}

/** Write a number with three significant digits. */
function shortText(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(1).replace("-", MINUS).replace("e+", "e");
  return String(Number(value.toPrecision(size >= 1000 ? 4 : 3))).replace("-", MINUS);
}

const RAISED = ["⁰", "¹", "²", "³", "⁴", "⁵", "⁶", "⁷", "⁸", "⁹"];

/** Write a value beside an axis: short, powers of ten as such. */
function tickText(value) {
  const size = Math.abs(value);
  if (size === 0 || (size < 1e4 && size >= 1e-3)) return shortText(value);
  const power = Math.floor(Math.log10(size) + 1e-9);
  const digits = [...String(Math.abs(power))].map((digit) => RAISED[digit]).join("");
  const factor = Number((value / 10 ** power).toPrecision(2));
  return `${factor === 1 ? "" : `${factor}·`.replace("-", MINUS)}10${power < 0 ? "⁻" : ""}${digits}`;
}

/** Return the index of the entry of an ascending list that is nearest to a value. */
function nearestIndex(ascending, value) {
  let low = 0;
  let high = ascending.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (ascending[middle] <= value) low = middle;
    else high = middle;
  }
  return value - ascending[low] <= ascending[high] - value ? low : high;
}

/** Return the least and the largest of all finite values in lists, or null where there is none. */
function rangeOf(lists) {
  let low = Infinity;
  let high = -Infinity;
  for (const list of lists) {
    for (const value of list) {
      if (value === null || !Number.isFinite(value)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  return low <= high ? [low, high] : null;
}

/** Return the value below which a share of a list lies. */
function quantile(values, share) {
  const sorted = values.filter((value) => value !== null).sort((a, b) => a - b);
  return sorted[Math.round(share * (sorted.length - 1))];
}
