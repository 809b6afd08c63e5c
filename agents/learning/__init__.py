"""What all algorithms share: actor and critics, networks, policies, advantages, batches, surrogates."""
