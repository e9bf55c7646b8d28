// Inverse compositional Gauss-Newton on the correlation: one work group a sample, lanes take
// pixels. See `descend` of track/flow.py; the two-by-two system is solved in double precision.
uniform int iterations;

shared float lines[(SIDE + 3) * SIDE]; // the view interpolated along rows

const float MAX_STEP = 1.0, DONE = 0.005;

vec4 cubic(float t) {
    return vec4(((-0.5 * t + 1.0) * t - 0.5) * t, 1.5 * t * t * t - 2.5 * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t, (0.5 * t - 0.5) * t * t);
}

// Fill `lines` for a window moved by a fraction of pixels; false outside the image.
bool moved(ivec2 corner, vec2 shift, float level) {
    ivec2 first = corner + ivec2(floor(shift)) - 1;
    if (any(lessThan(first, ivec2(0)))
        || any(greaterThan(first + ivec2(COLUMNS, SIDE) + 3, size)))
        return false;
    vec4 across = cubic(fract(shift.x));
    meet(); // the last lines have been read
    for (int at = lane(); at < (SIDE + 3) * SIDE; at += LANES) {
        int from = (first.y + at / SIDE) * size.x + first.x + at % SIDE;
        vec4 four = vec4(view[from], view[from + 1], view[from + 2], view[from + 3]);
        lines[at] = dot(across, four - level);
    }
    meet();
    return true;
}

// Correlation, and the steepest descent images times the normalised difference.
vec3 residual(float along_part) {
    vec4 along = cubic(along_part);
    float sums[SUMS] = float[](0.0, 0.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < OWN; ++k) {
        int pixel = lane() + k * LANES;
        if (share[k] == 0.0)
            continue;
        float seen = dot(along, vec4(lines[pixel], lines[pixel + SIDE], lines[pixel + 2 * SIDE],
            lines[pixel + 3 * SIDE]));
        float part = share[k] * seen;
        sums[0] += part;
        sums[1] += part * seen;
        sums[2] += part * value[k];
        sums[3] += part * slope[k].x;
        sums[4] += part * slope[k].y;
    }
    add_lanes(sums);
    float variance = sums[1] - sums[0] * sums[0];
    if (variance < FLAT)
        return vec3(NONE, 0.0, 0.0);
    return vec3(sums[2], sums[3], sums[4]) / sqrt(variance);
}

vec3 hessian() { // xx, xy, yy
    float sums[SUMS] = float[](0.0, 0.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < OWN; ++k) {
        sums[0] += share[k] * slope[k].x * slope[k].x;
        sums[1] += share[k] * slope[k].x * slope[k].y;
        sums[2] += share[k] * slope[k].y * slope[k].y;
    }
    add_lanes(sums);
    return vec3(sums[0], sums[1], sums[2]);
}

Match descend(Sample own) {
    Match lost = Match(vec4(0.0, 0.0, NONE, 0.0), vec4(0.0));
    if (!hold_window(own, true))
        return lost;
    vec3 form = hessian();
    double xx = form.x, xy = form.y, yy = form.z, determinant = xx * yy - xy * xy;
    if (determinant < 1e-8lf)
        return lost;
    ivec2 corner = own.place.yz;
    float level = near(corner + SIDE / 2 + own.shift);
    vec2 shift = own.start;
    vec3 now = vec3(NONE, 0.0, 0.0);
    for (int turn = 0; turn <= iterations; ++turn) {
        if (!moved(corner, shift, level))
            return lost;
        now = residual(fract(shift.y));
        if (now.x <= NONE || turn == iterations)
            break;
        double bx = now.y, by = now.z;
        vec2 move = vec2(xy * by - yy * bx, xy * bx - xx * by) / float(determinant);
        float length_px = max(abs(move.x), abs(move.y));
        shift += move * (MAX_STEP / max(length_px, MAX_STEP));
        if (length_px < DONE)
            break;
    }
    return Match(vec4(shift, now.x, 0.0), vec4(form, 0.0));
}

void main() {
    if (group() >= count)
        return;
    Match match = descend(samples[group()]);
    if (lane() == 0)
        matches[group()] = match;
}
