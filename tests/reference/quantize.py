"""Quantised pages as docs/format.md defines them, one gaussian at a time, without
regard to speed."""

import itertools

import numpy as np

F = np.float32
RANGE_BYTES = (40, 48, 52, 60)


def sh_bits(sh_degree, band):
    """Return the bits of brightness, orange and green."""
    return {1: (7, 7, 7), 2: (7, 5, 4), 3: (5 if band == 1 else 6, 4, 3)}[sh_degree]


def channels_of(rgb):
    red, green, blue = np.moveaxis(rgb, -1, 0)
    return np.stack(
        [(red + 2 * green + blue) / 4, (red - blue) / 2, (2 * green - red - blue) / 4], axis=-1
    )


def bits_of(words):
    """Return the lowest bits of a string of bits."""
    return "".join(f"{int(word):032b}"[::-1] for word in words)


def number(bits, first, count):
    return int(bits[first : first + count][::-1], 2)


def decode(page, offset, sh_degree, *, fused):
    """Return means, quats, scales, opacities and sh; if `fused`, products are not
    rounded before they are added."""
    n, num_sh = int(offset[-1]), (sh_degree + 1) ** 2

    def sum_of(a, code, step):
        if fused:
            return F(np.longdouble(a) + np.longdouble(code) * np.longdouble(step))
        return F(a) + F(code) * F(step)

    out = [np.empty(shape, F) for shape in ((n, 3), (n, 4), (n, 3), (n,), (n, num_sh, 3))]
    means, quats, scales, opacities, sh = out
    for c, (begin, end) in enumerate(itertools.pairwise(offset)):
        place = (16 + 8 * sh_degree) * n + RANGE_BYTES[sh_degree] * c
        ranges = page[place : place + RANGE_BYTES[sh_degree]].tobytes()
        mean_first, mean_step = np.frombuffer(ranges, "<f4", 6).reshape(2, 3)
        color_first, color_step = np.frombuffer(ranges, "<f2", 6, 24).astype(F).reshape(2, 3)
        scale_first, scale_step = np.frombuffer(ranges, "<u2", 2, 36).tolist()
        sh_step = np.frombuffer(ranges, "<f2", 3 * sh_degree, 40).astype(F).reshape(sh_degree, 3)
        for i in range(begin, end):
            bits = bits_of(page[16 * i : 16 * i + 16].view("<u4"))
            for k, first in enumerate((0, 12, 32)):
                means[i, k] = sum_of(mean_first[k], number(bits, first, 12), mean_step[k])
            opacities[i] = F(number(bits, 24, 8)) * (F(1) / F(255))
            for k, first in enumerate((44, 54, 64)):
                code = (
                    (63 << 23) + (scale_first << 14) + number(bits, first, 10) * (scale_step << 4)
                )
                scales[i, k] = np.array(code, "<u4").view("<f4")
            xyz = [number(bits, first, 9) - 255 for first in (74, 83, 119)]
            w = np.sqrt(F(444016 - sum(x * x for x in xyz)))
            quats[i] = [F(x) * F(0.0015007235) for x in (w, *xyz)]
            for k, first in enumerate((92, 101, 110)):
                sh[i, 0, k] = sum_of(color_first[k], number(bits, first, 9), color_step[k] / F(256))
            first = 16 * n + 8 * sh_degree * i
            bits = bits_of(page[first : first + 8 * sh_degree].view("<u4"))
            first = 0
            for basis in range(1, num_sh):
                band = int(basis**0.5)
                value = []
                for count, step in zip(sh_bits(sh_degree, band), sh_step[band - 1], strict=True):
                    code = number(bits, first, count) - (2 ** (count - 1) - 1)
                    value.append((code * abs(code), step / F(256)))
                    first += count
                (y, y_step), (o, o_step), (g, g_step) = value
                luma, green = F(y) * y_step, F(g) * g_step
                base = sum_of(-green, y, y_step)
                sh[i, basis] = [
                    sum_of(base, o, o_step),
                    sum_of(green, y, y_step) if fused else luma + green,
                    sum_of(base, -o, o_step),
                ]
    return out
