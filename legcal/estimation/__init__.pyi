from .loss import cost_of as cost_of
from .loss import efficiency as efficiency
from .loss import width_to_k as width_to_k
from .noise import NoiseModel as NoiseModel
from .noise import estimate_noise as estimate_noise
from .noise import noise_of_the_median as noise_of_the_median
from .variances import Effects as Effects
from .variances import estimate_variances as estimate_variances
