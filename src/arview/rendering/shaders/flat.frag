#version 330 core
// The component id as it is, without light.
flat in vec4 component_color;
out vec4 frag_color;

void main()
{
    frag_color = component_color;
}
