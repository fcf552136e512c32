"""The capsules of the zoo, as `ENVIRONMENT/MODEL.safetensors`. The package `stable_worldmodel` finds them there."""
