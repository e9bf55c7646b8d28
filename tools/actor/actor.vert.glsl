#version 430
// World position and normal, and everything that is fixed to the skin at rest.
in vec3 position;
in vec3 normal;
in vec3 rest;
in vec3 rest_normal;
in vec4 paint;   // albedo, brow, hair, lip
in vec2 kind;    // 0 skin, 1 eye, 2 teeth; wet
uniform mat4 clip_from_world;
uniform vec3 eye_row;  // third row of camera_from_world's rotation
uniform float eye_depth;
out vec3 world_position;
out vec3 world_normal;
out vec3 rest_position;
out vec3 rest_facing;
out vec4 vertex_paint;
flat out float vertex_kind;
out float vertex_wet;
out float camera_depth;

void main() {
    world_position = position;
    world_normal = normal;
    rest_position = rest;
    rest_facing = rest_normal;
    vertex_paint = paint;
    vertex_kind = kind.x;
    vertex_wet = kind.y;
    camera_depth = dot(eye_row, position) + eye_depth;
    gl_Position = clip_from_world * vec4(position, 1.0);
}
