// Converts colours between text and numbers.

/**
 * Returns a colour as text of the form #rrggbb.
 *
 * @param {number[]} color Red, green and blue, 0 to 1.
 */
export function hexOf(color) {
  const digits = color.map((part) =>
    Math.round(255 * part)
      .toString(16)
      .padStart(2, "0"),
  );
  return `#${digits.join("")}`;
}

/**
 * Returns red, green and blue, 0 to 1. If the text is not a colour, the result is
 * black.
 *
 * @param {string} text Six hexadecimal digits, with or without #.
 * @returns {[number, number, number]}
 */
export function colorOf(text) {
  if (!/^#?[0-9a-f]{6}$/i.test(text)) return [0, 0, 0];
  const number = Number.parseInt(text.replace("#", ""), 16);
  return [(number >> 16) / 255, ((number >> 8) & 255) / 255, (number & 255) / 255];
}
