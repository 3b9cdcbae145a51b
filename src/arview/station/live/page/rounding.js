// Numbers with the decimals that their uncertainty allows, as in arview.inspection.rounding: U has two significant digits.

import { decimal } from "./texts/texts.js";

const MAX_DECIMALS = 6, EXACT_DECIMALS = 4;

/** Number of decimals of a value with this expanded uncertainty. */
export function decimalsOf(u) {
  if (!(u > 0)) return EXACT_DECIMALS;
  return Math.min(Math.max(1 - Number(u.toExponential(1).split("e")[1]), 0), MAX_DECIMALS);
}

/** A measured value, or U itself. */
export const rounded = (value, u) => decimal(value.toFixed(u > 0 ? decimalsOf(u) : 2));

/** An exact number such as a tolerance, without the noise of binary fractions. */
export const exact = (value) => decimal(String(Number(value.toFixed(EXACT_DECIMALS))));

export { decimal };
