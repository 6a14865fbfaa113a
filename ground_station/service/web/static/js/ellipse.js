// @ts-check
/**
 * Half axes and direction of the ellipse {x : xᵀ P⁻¹ x = k²} of a 2x2 covariance, by its
 * eigenvalues in closed form.
 * @param {number} xx @param {number} xy @param {number} yy m² @param {number} k how many sigmas
 * @returns {{major_m: number, minor_m: number, angle_rad: number}|null} null for no covariance
 */
export function ellipseOf(xx, xy, yy, k) {
  if (![xx, xy, yy].every(Number.isFinite) || xx < 0 || yy < 0) return null;
  const mean = (xx + yy) / 2;
  const spread = Math.hypot((xx - yy) / 2, xy);
  return {
    major_m: k * Math.sqrt(mean + spread),
    minor_m: k * Math.sqrt(Math.max(0, mean - spread)),
    angle_rad: Math.atan2(2 * xy, xx - yy) / 2,
  };
}
