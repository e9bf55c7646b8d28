// Skin, eyes and teeth under a rig of broad lamps. Detail is looked up by rest position along the
// three axes and mixed by the rest normal, so that it sticks to the moving surface.
in vec3 world_position;
in vec3 world_normal;
in vec3 rest_position;
in vec3 rest_facing;
in vec4 vertex_paint;
in float vertex_wet;
uniform vec3 eye;
uniform sampler2D tile;
uniform float tile_mm;
uniform float gloss;
uniform int wanted;  // 0 radiance, 1 albedo
out float result;

const int LAMPS = 5;
const vec3 LAMP[LAMPS] = vec3[LAMPS](
    vec3(0.44, 0.52, 0.73), vec3(-0.66, 0.30, 0.69), vec3(0.05, -0.45, 0.89),
    vec3(0.93, 0.05, 0.36), vec3(-0.93, 0.10, 0.35));
const float POWER[LAMPS] = float[LAMPS](0.62, 0.40, 0.20, 0.26, 0.26);

struct Surface { float albedo; vec3 tilt; float specular; float sharpness; };

#if defined(EYE)
Surface surface() {
    vec3 d = normalize(rest_position);
    float r = acos(clamp(d.z, -1.0, 1.0)) * 12.6;
    float turn = atan(d.y, d.x);
    float fibre = texture(tile, vec2(r * 0.02, turn * 0.35)).w;
    float vein = texture(tile, rest_position.xy / tile_mm * 1.5).x;
    float white = 0.52 - 0.018 * max(r - 6.0, 0.0) + 0.25 * (vein - 0.45);
    float iris = 0.20 + 0.30 * (fibre - 0.5) + 0.05 * smoothstep(2.0, 4.5, r);
    Surface s;
    s.albedo = mix(iris, 0.07, smoothstep(4.9, 5.8, r));
    s.albedo = mix(s.albedo, white, smoothstep(5.7, 6.3, r));
    s.albedo = mix(0.015, s.albedo, smoothstep(2.1, 2.5, r));
    s.albedo *= 1.0 - 0.5 * smoothstep(1.0, 7.5, rest_position.y);  // the shade of the upper lid
    s.tilt = vec3(0.0);
    s.specular = 0.22;
    s.sharpness = 260.0;
    return s;
}
#elif defined(TOOTH)
Surface surface() {
    float height = rest_position.y;
    float cell = abs(fract(rest_position.x / 7.6) - 0.5);
    float gum = 8.0 - 2.4 * cell * cell * 4.0;
    float enamel = 0.60 + 0.3 * (texture(tile, rest_position.xy / tile_mm * 2.0).x - 0.45);
    enamel *= mix(0.35, 1.0, smoothstep(0.0, 0.05, cell)) * (1.0 - 0.018 * abs(rest_position.x));
    Surface s;
    s.albedo = mix(enamel, 0.30, smoothstep(gum - 0.4, gum + 0.4, height)) * 0.8;
    s.tilt = vec3(0.0);
    s.specular = 0.25;
    s.sharpness = 80.0;
    return s;
}
#else
Surface surface() {
    vec3 facing = abs(normalize(rest_facing));
    facing *= facing;
    facing *= facing;
    facing /= facing.x + facing.y + facing.z;
    vec3 place = rest_position / tile_mm;
    vec4 front = texture(tile, place.xy);
    vec4 side = texture(tile, place.zy + vec2(0.37, 0.11));
    vec4 above = texture(tile, place.xz + vec2(0.71, 0.53));
    vec4 detail = front * facing.z + side * facing.x + above * facing.y;
    vec2 a = (front.yz - 0.5) * facing.z;
    vec2 b = (side.yz - 0.5) * facing.x;
    vec2 c = (above.yz - 0.5) * facing.y;
    float lip = vertex_paint.w;
    float dry = 1.0 - vertex_wet;
    float factor = 2.0 * detail.x;
    Surface s;
#ifdef PLAIN
    s.albedo = vertex_paint.x * mix(factor, 1.0, 0.6 * vertex_wet);
    s.tilt = vec3(a + vec2(c.x, 0.0) + vec2(0.0, b.y), b.x + c.y) * dry;
    s.specular = mix(gloss * 0.085, 0.02, vertex_wet);
    s.sharpness = 20.0;
    return s;
#else
    float wrinkle = texture(tile, place.yx * 1.6).w - 0.5;
    float strand = texture(tile, vec2(place.x, place.y - 0.35 * abs(place.x)) * 1.5).w - 0.5;
    factor = mix(factor, 1.0 + 0.5 * (factor - 1.0) + 0.55 * wrinkle, lip);
    s.albedo = vertex_paint.x * mix(factor, 1.0, 0.6 * vertex_wet);
    float brow = smoothstep(0.30, 0.95, vertex_paint.y + 0.8 * strand * step(0.01, vertex_paint.y));
    s.albedo = mix(s.albedo, 0.10 + 0.10 * max(strand, 0.0), 0.88 * brow);
    float hair = smoothstep(0.25, 0.75, vertex_paint.z + 1.1 * (detail.w - 0.5) * vertex_paint.z);
    s.albedo = mix(s.albedo, 0.09 + 0.30 * detail.w * detail.w + 0.06 * (factor - 0.9), 0.88 * hair);
    s.tilt = vec3(a + vec2(c.x, 0.0) + vec2(0.0, b.y), b.x + c.y) * dry * (1.0 - 0.6 * lip);
    s.tilt.x += 0.25 * wrinkle * lip;
    s.specular = gloss * mix(0.085, 0.14, lip) * (1.0 - 0.6 * hair) * (1.0 - 0.8 * brow);
    s.specular = mix(s.specular, 0.02, vertex_wet);
    s.sharpness = mix(20.0, 42.0, lip);
    return s;
#endif
}
#endif

void main() {
    Surface s = surface();
    if (wanted == 1) { result = s.albedo; return; }
    if (!gl_FrontFacing) { result = 0.01; return; }
    vec3 n = normalize(world_normal);
    n = normalize(n - 0.9 * (s.tilt - dot(s.tilt, n) * n));
    vec3 view = normalize(eye - world_position);
    float light = 0.16 * (0.8 + 0.2 * n.y) * s.albedo;
    for (int i = 0; i < LAMPS; i++) {
        float facing = dot(n, LAMP[i]);
        light += s.albedo * POWER[i] * max(0.0, (facing + 0.12) / 1.12);
        vec3 halfway = normalize(LAMP[i] + view);
        float shine = exp2(1.4427 * s.sharpness * (dot(n, halfway) - 1.0));
        light += s.specular * POWER[i] * shine * (s.sharpness + 8.0) / 25.0 * step(0.0, facing);
    }
    result = light;
}
